"""How long SAM 2.1 takes for an image of a stream, from the camera's array to the object's mask on the host.

The architecture is that of the public checkpoint `facebook/sam2.1-hiera-tiny`; the weights are random, on
which the time does not depend. Throws of 30 images each begin with a prompt, so that the memory grows as on
the robot. Each setting prints a line of JSON: times in ms, and the share of images that took longer than the
33 ms between two images of a 30 Hz camera. Images come one right after the other. `--sizes` are sides of the
model's image [px]; `--folder` is a checkpoint, in place of random weights.

Run: python benchmarks/sam2_speed.py
     python benchmarks/sam2_speed.py --device cpu --settings eager --sizes 256 --frames 20
"""

import json
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import transformers
import tyro
from transformers import Sam2VideoConfig, Sam2VideoModel

from pixel2catch.perception.sam2 import Sam2Segmenter
from pixel2catch.perception.segmenter import BoxPrompt

LIMIT = 1000.0 / 30.0  #: Time between two images [ms].
THROW_IMAGES, WARM_UP_IMAGES = 30, 60
HEIGHT, WIDTH = 480, 640
BOX = BoxPrompt(box=(300.0, 200.0, 340.0, 240.0))


def write_checkpoint(folder: Path) -> None:
    """Write the architecture with random weights that always find something."""
    torch.manual_seed(0)
    model = Sam2VideoModel(Sam2VideoConfig())
    torch.nn.init.constant_(model.mask_decoder.pred_obj_score_head.proj_out.bias, 9.0)
    model.save_pretrained(folder)


def times_of(segmenter: Sam2Segmenter, count: int) -> np.ndarray:
    """Times of a number of images [ms]; NaN for those that begin a throw."""
    images = np.random.default_rng(0).integers(0, 256, (8, HEIGHT, WIDTH, 3), dtype=np.uint8)
    times = np.full(count, np.nan)
    for index in range(count):
        image, is_start = images[index % len(images)], index % THROW_IMAGES == 0
        begin = time.perf_counter()
        segmenter.find(image, prompt=BOX if is_start else None)
        if not is_start:
            times[index] = 1000.0 * (time.perf_counter() - begin)
    return times


def measure(folder: Path, setting: str, device: str, size: int, count: int) -> dict[str, Any]:
    """Load and warm up as the robot does, then time a number of images; to compile takes a minute."""
    begin = time.perf_counter()
    segmenter = Sam2Segmenter(folder, device, size, is_compiled=setting == "compiled")
    times_of(segmenter, WARM_UP_IMAGES if device != "cpu" else 2)
    ready = time.perf_counter() - begin
    times = times_of(segmenter, count)
    p50, p95, p99 = np.nanpercentile(times, (50, 95, 99)).round(3).tolist()
    is_cpu = device == "cpu"
    return {
        "setting": setting,
        "image_size": size,
        "device": f"CPU, {torch.get_num_threads()} threads" if is_cpu else torch.cuda.get_device_name(device),
        "torch": torch.__version__,
        "transformers": transformers.__version__,
        "seconds_to_ready": round(ready, 1),
        "images": count,
        **{"p50": p50, "p95": p95, "p99": p99, "max": round(float(np.nanmax(times)), 3)},
        "late": round(float((times[np.isfinite(times)] > LIMIT).mean()), 3),
    }


def main(
    device: str = "cuda",
    settings: tuple[Literal["eager", "compiled"], ...] = ("eager", "compiled"),
    sizes: tuple[int, ...] = (1024, 512),
    frames: int = 300,
    folder: Path | None = None,
) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        if folder is None:
            write_checkpoint(folder := Path(temporary))
        for size, setting in product(sizes, settings):
            print(json.dumps(measure(folder, setting, device, size, frames)), flush=True)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
