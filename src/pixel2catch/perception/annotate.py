"""Pictures of what the perception sees: box, mask outline, verdict, and the features of the last seconds."""

from collections import deque

import cv2
import numpy as np
from jaxtyping import UInt8

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.perception.extractor import Extraction
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.perception.segmenter import Image
from pixel2catch.perception.tracking import Sighting
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

Color = tuple[int, int, int]
Canvas = UInt8[np.ndarray, "rows columns 3"]

SEEN, HELD, STALE = (80, 255, 80), (255, 190, 60), (255, 80, 80)
"""Colours of a box that was just seen, of one that is held, and of one too old."""

UNKNOWN, OUTLINE, TEXT, FRAME = (120, 120, 120), (255, 80, 255), (235, 235, 235), (70, 70, 70)
HEADER = 24  #: Height of the line of text [px].
PLOT_ROWS, PLOT_COLUMNS, PLOT_HEIGHT = 2, 4, 72  #: The features' plots; their height is in pixels.
HISTORY = 150  #: Control steps in a plot: 5 s.

LIMITS = {
    **dict.fromkeys(("cx", "cy"), (0.0, 1.0)),
    **dict.fromkeys(("w", "h"), (0.0, 0.25)),
    **dict.fromkeys(("dcx", "dcy"), (-60.0, 60.0)),
    **dict.fromkeys(("dw", "dh"), (-20.0, 20.0)),
}
"""Lower and upper end of a plot; differences in pixels. Source: ours; rendered catches move by 61 px."""


class Annotator:
    """Draws one picture per control step, all of one size; it remembers what the plots show."""

    def __init__(self, camera: CameraSpec = RGB_CAMERA) -> None:
        """Begin with empty plots beside images of the camera's size."""
        self._camera = camera
        self._past: deque[tuple[np.ndarray, Color]] = deque(maxlen=HISTORY)

    def picture(self, sighting: Sighting) -> Canvas:
        """Return the image with all that is drawn on it: a line of text above, the plots below."""
        seen, color = sighting.extraction, _color(sighting.extraction)
        self._past.append((seen.features[0].numpy(), color))
        return np.concatenate([self._header(sighting), self._image(sighting, color), self._plots()])

    def _header(self, sighting: Sighting) -> Canvas:
        seen = sighting.extraction
        age = f"{1e3 * seen.age:.0f} ms old" if seen.is_valid else "never seen"
        took = f"{1e3 * sighting.durations.get('total', 0.0):.1f} ms"
        words = [f"{sighting.time:7.2f} s", str(seen.verdict), age, f"score {seen.score:.2f}", took]
        words += filter(None, (seen.source, seen.doubt))
        header = np.zeros((HEADER, self._camera.width, 3), dtype=np.uint8)
        _write(header, "   ".join(words), (8, HEADER - 8), _color(seen))
        return header

    def _image(self, sighting: Sighting, color: Color) -> Image:
        """The image with box and outline; a black one where it is none of the camera's."""
        seen, frame = sighting.extraction, sighting.tick.frame
        shape = (self._camera.height, self._camera.width, 3)
        if seen.verdict is Verdict.BAD_IMAGE:
            return np.zeros(shape, dtype=np.uint8)
        image = frame.image.copy()
        if seen.mask is not None:
            mask = seen.mask.view(np.uint8)
            outline, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, outline, -1, OUTLINE, 1)
        if seen.is_valid:
            xmin, ymin, xmax, ymax = (round(edge) for edge in seen.box[0].tolist())
            cv2.rectangle(image, (xmin - 1, ymin - 1), (xmax, ymax), color, 1)
        return image

    def _plots(self) -> Canvas:
        """All plots, as a strip as wide as the image."""
        strip = np.zeros((PLOT_ROWS * PLOT_HEIGHT, self._camera.width, 3), dtype=np.uint8)
        width = self._camera.width // PLOT_COLUMNS
        values = np.stack([features for features, _ in self._past])
        for i, name in enumerate(PIXEL_FEATURES):
            top, left = PLOT_HEIGHT * (i // PLOT_COLUMNS), width * (i % PLOT_COLUMNS)
            part = strip[top : top + PLOT_HEIGHT, left : left + width]
            _plot(part, name, values[:, i], [color for _, color in self._past])
        return strip


def _plot(canvas: Canvas, name: str, values: np.ndarray, colors: list[Color]) -> None:
    """Draw one feature's last values into its part of the strip, the newest at the right."""
    height, width = canvas.shape[:2]
    low, high = LIMITS[name]
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    rows = np.rint((height - 4) - share * (height - 8)).astype(int).tolist()
    columns = np.rint((width - 2) - np.arange(len(values))[::-1] * (width - 3) / HISTORY).astype(int).tolist()
    places = list(zip(columns, rows, strict=True))
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), FRAME, 1)
    if low < 0.0:
        cv2.line(canvas, (0, height // 2), (width - 1, height // 2), FRAME, 1)
    for start, end, color in zip(places[:1] + places[:-1], places, colors, strict=True):
        cv2.line(canvas, start, end, color, 1)
    _write(canvas, f"{name} {values[-1]:.3g}{' px' if low < 0.0 else ''}", (6, 15), TEXT)


def _color(seen: Extraction) -> Color:
    if not seen.is_valid:
        return UNKNOWN
    if seen.verdict is Verdict.SEEN:
        return SEEN
    return HELD if seen.is_fresh else STALE


def _write(canvas: Canvas, text: str, place: tuple[int, int], color: Color) -> None:
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
