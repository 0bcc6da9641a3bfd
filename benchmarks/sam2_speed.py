"""How long SAM 2.1 takes for an image of a stream, from the camera's array to the object's box on the host.

The architecture is that of the public checkpoint `facebook/sam2.1-hiera-tiny`; the weights are random, on
which the time does not depend. Throws of 30 images each begin with a prompt, so that the memory grows as on
the robot. Without --folder an object's mask, 40 px wide, replaces the mask of the random weights; with
`noise_` it stays, hundreds of specks. Every setting runs in a process of its own
and prints lines of JSON: times in ms, and the share of images that are late, which took longer than the 33 ms
between two images of a 30 Hz camera. Images come one right after the other, or at 30 Hz (`paced`); first with
Python's collector of garbage as it is, then with all there is frozen, as `deploy` does.

Run: python benchmarks/sam2_speed.py
     python benchmarks/sam2_speed.py --device cpu --settings eager --sizes 256 --frames 20
"""

import argparse
import gc
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from transformers import Sam2VideoConfig, Sam2VideoModel

from pixel2catch.perception.regions import find_blobs
from pixel2catch.perception.sam2 import Sam2Segmenter
from pixel2catch.perception.segmenter import BoxPrompt, Segmentation, Segmenter

LIMIT = 1000.0 / 30.0
THROW_IMAGES = 30
WARM_UP_IMAGES = 30
BUSY_IMAGES = 30
HEIGHT, WIDTH = 480, 640
BOX = BoxPrompt(box=(300.0, 200.0, 340.0, 240.0))
SETTINGS = {"eager": False, "compiled": True, "noise_compiled": True}
"""What is tried, and whether `torch.compile` compiles the model first: a minute, with a C compiler."""


def write_checkpoint(folder: Path) -> None:
    """Write the architecture with random weights that always find something."""
    torch.manual_seed(0)
    model = Sam2VideoModel(Sam2VideoConfig())
    torch.nn.init.constant_(model.mask_decoder.pred_obj_score_head.proj_out.bias, 9.0)
    model.save_pretrained(folder)


class ObjectInPlace(Sam2Segmenter):
    """Runs the model, and returns an object in the middle of the image, whatever it computes."""

    def _segment(self, session: Any, image: np.ndarray) -> Segmentation:
        found = super()._segment(session, image)
        mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
        mask[HEIGHT // 2 : HEIGHT // 2 + 30, WIDTH // 2 : WIDTH // 2 + 40] = True
        return replace(found, mask=mask)


def build(folder: Path, setting: str, device: str, size: int, *, objects: bool) -> Segmenter:
    """Load and warm up as the robot does."""
    kind = ObjectInPlace if objects and not setting.startswith("noise") else Sam2Segmenter
    return kind(folder, device, size, is_compiled=SETTINGS[setting])


def stream(
    segmenter: Segmenter, count: int, interval: float = 0.0
) -> Iterator[tuple[bool, float, float, bool, bool]]:
    """Run images at an interval [s]; yield of each: begins a throw; ms to mask, to box; is found; is late."""
    images = np.random.default_rng(0).integers(0, 256, (8, HEIGHT, WIDTH, 3), dtype=np.uint8)
    first = time.perf_counter()
    for index in range(count):
        image, is_start = images[index % len(images)], index % THROW_IMAGES == 0
        time.sleep(max(first + index * interval - time.perf_counter(), 0.0))
        begin = time.perf_counter()
        result = segmenter.start(image, BOX) if is_start else segmenter.track(image)
        to_mask = time.perf_counter()
        if result.mask is not None:
            _ = find_blobs(result.mask)[0].box
        took = 1000.0 * (time.perf_counter() - begin)
        yield is_start, 1000.0 * (to_mask - begin), took, result.mask is not None, took > LIMIT


def measure(folder: Path, setting: str, device: str, size: int, count: int, *, objects: bool) -> None:
    """Print one line for one setting, and on CUDA a second one: for how long the device was busy."""
    begin = time.perf_counter()
    segmenter = build(folder, setting, device, size, objects=objects)
    for _ in stream(segmenter, WARM_UP_IMAGES if device != "cpu" else 2):
        pass
    ready = time.perf_counter() - begin
    report({"setting": setting, "image_size": size, "seconds_to_ready": ready, **machine(device)})
    for name, interval in (("as it is", 0.0), ("frozen", 0.0), ("frozen, paced", LIMIT / 1000.0)):
        if name == "frozen":
            gc.collect()
            gc.freeze()
        found = timings(segmenter, count, interval)
        report({"setting": setting, "image_size": size, "stream": name, "images": count, **found})
    if device != "cpu":
        report({"setting": setting, "image_size": size, **busy_time(segmenter)})


def timings(segmenter: Segmenter, count: int, interval: float) -> dict[str, float]:
    """Times [ms] and shares of so many images."""
    pauses: list[tuple[str, int, float]] = []

    def note(phase: str, info: dict[str, int]) -> None:
        pauses.append((phase, info["generation"], time.perf_counter()))

    gc.callbacks.append(note)
    columns = zip(*stream(segmenter, count, interval), strict=True)
    is_start, to_mask, times, is_found, is_late = (np.array(column) for column in columns)
    gc.callbacks.remove(note)
    collected = [1000.0 * (end[2] - begin[2]) for begin, end in zip(pauses[::2], pauses[1::2], strict=True)]
    tracked = times[~is_start]
    p50, p95, p99 = np.percentile(tracked, (50, 95, 99))
    return {
        "p50": p50,
        "p95": p95,
        "p99": p99,
        "max": tracked.max(),
        "mask_p95": np.percentile(to_mask[~is_start], 95),
        "start_p50": float(np.median(times[is_start])),
        "late": is_late.mean(),
        "found": is_found.mean(),
        "collections": len(collected),
        "longest_collection": max(collected, default=0.0),
    }


def machine(device: str) -> dict[str, Any]:
    """What it ran on."""
    versions = {"torch": torch.__version__, "transformers": transformers.__version__}
    if device == "cpu":
        return {"device": f"CPU, {torch.get_num_threads()} threads", **versions}
    peak = torch.cuda.max_memory_reserved(device) / 2**30
    return {"device": torch.cuda.get_device_name(device), "peak_gib": peak, **versions}


def busy_time(segmenter: Segmenter) -> dict[str, Any]:
    """Time of all kernels and copies for an image [ms], which launching cannot save, and of the longest."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in stream(segmenter, BUSY_IMAGES):
            pass
    events = sorted(profile.key_averages(), key=lambda event: -event.self_device_time_total)
    each = [(event.key[:60], event.self_device_time_total / 1000.0 / BUSY_IMAGES) for event in events]
    return {
        "busy": sum(took for _, took in each),
        "longest": [(key, round(took, 3)) for key, took in each[:16]],
    }


def report(line: dict[str, Any]) -> None:
    """Print rounded JSON."""
    numbers = {name: round(float(value), 3) for name, value in line.items() if isinstance(value, float)}
    print(json.dumps({**line, **numbers}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument(
        "--sizes", nargs="+", type=int, default=[1024, 512], help="side of the model's image [px]"
    )
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--timeout", type=float, default=240.0, help="for one setting [s]")
    parser.add_argument("--folder", type=Path, help="a checkpoint; default: random weights")
    parser.add_argument(
        "--here", action="store_true", help="in this process, the first setting and size only"
    )
    parser.add_argument("--objects", action="store_true", help="masks are objects, whatever the model says")
    options = parser.parse_args()
    if options.here:
        setting, size = options.settings[0], options.sizes[0]
        return measure(options.folder, setting, options.device, size, options.frames, objects=options.objects)
    with tempfile.TemporaryDirectory() as temporary:
        if options.folder is None:
            options.folder, options.objects = Path(temporary), True
            write_checkpoint(options.folder)
        for size in options.sizes:
            for setting in options.settings:
                run_apart(setting, size, options)


def run_apart(setting: str, size: int, options: argparse.Namespace) -> None:
    """Measure in another process; if that fails, say so and leave the others alone."""
    command = [sys.executable, __file__, "--here", "--settings", setting, "--sizes", str(size)]
    command += ["--device", options.device, "--frames", str(options.frames), "--folder", str(options.folder)]
    command += ["--objects"] if options.objects else []
    try:
        subprocess.run(command, check=True, timeout=options.timeout)
    except subprocess.CalledProcessError as error:
        report({"setting": setting, "image_size": size, "failed": f"exit status {error.returncode}"})
    except subprocess.TimeoutExpired:
        report({"setting": setting, "image_size": size, "failed": f"longer than {options.timeout:g} s"})


if __name__ == "__main__":
    main()
