"""What the package `lerobot` says of a data set, as JSON; run by a Python that has it."""

import json
import sys

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

IMAGES = "observation.images.rgb"
STEP = 1.0 / 30.0
dataset = LeRobotDataset("local/judged", root=sys.argv[1], delta_timestamps={"action": [0.0, STEP]})
items = [dataset[i] for i in range(len(dataset))]
batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=len(dataset))))
print(
    json.dumps(
        {
            "num_episodes": dataset.num_episodes,
            "num_steps": len(dataset),
            "fps": dataset.fps,
            "tasks": [item["task"] for item in items],
            "episodes": [int(item["episode_index"]) for item in items],
            "state": [item["observation.state"].tolist() for item in items],
            "actions": [item["action"].tolist() for item in items],
            "is_pad": [item["action_is_pad"].tolist() for item in items],
            "done": [bool(item["next.done"]) for item in items],
            "image_shape": list(items[0][IMAGES].shape),
            "brightness": [float(255.0 * item[IMAGES].mean()) for item in items],
            "batch": list(batch[IMAGES].shape),
            "mean": dataset.meta.stats["action"]["mean"].tolist(),
            "image_mean": list(dataset.meta.stats[IMAGES]["mean"].shape),
        }
    )
)
