"""The page of an evaluation, from throws by hand and as the command writes it."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from pixel2catch.cli.main import main
from pixel2catch.evaluation.page import landing_figure
from pixel2catch.evaluation.recorded_throws import OUTCOMES, RecordedThrow, ThrowCollection, landing
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.constants import OBJECT_POS, OBJECT_VEL


def throw(outcome: str, y: float = 0.0) -> RecordedThrow:
    """From 2.5 m away and 0.8 m high, with 2 m/s towards the robot and 4 m/s up."""
    qpos, qvel = np.zeros((4, 26)), np.zeros((4, 25))
    qpos[:, OBJECT_POS], qvel[2:, OBJECT_VEL] = (2.5, y, 0.8), (-2.0, 0.5, 4.0)
    return RecordedThrow(
        object_name="cube_s", outcome=outcome, qpos=qpos, qvel=qvel, box=np.zeros((4, 4)), num_untested=4
    )


def test_landing_by_hand():
    """It comes down to 1 m after (4 + √(16 - 2 · 9.81 · 0.2)) / 9.81 = 0.76 s; the top is after 0.41 s."""
    assert landing(throw("caught", y=0.1), 1.0) == pytest.approx((2.5 - 2.0 * 0.7619, 0.1 + 0.381), abs=1e-3)
    assert landing(throw("caught"), 5.0) == pytest.approx((2.5 - 2.0 * 0.4077, 0.2039), abs=1e-3)


def test_the_first_throw_of_each_outcome_is_kept():
    collection = ThrowCollection()
    collection.add([throw("caught", y=0.1), throw("dropped", y=0.2)])
    collection.add([throw("caught", y=0.3)])
    assert {name: len(points) for name, points in collection.landings.items()} == {"caught": 2, "dropped": 1}
    assert collection.examples["caught"].qpos[0, OBJECT_POS][1] == 0.1
    labels = [text.get_text() for text in landing_figure(collection).legends[0].get_texts()]
    assert labels == [f"{OUTCOMES['caught']} (2)", f"{OUTCOMES['dropped']} (1)"]


def test_the_command_writes_a_page_that_needs_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], opengl: None
):
    torch.manual_seed(0)
    Policy(contract_of(PROPOSED), hidden=(16,)).save(tmp_path / "policy")
    path = tmp_path / "page.html"
    given = ["--objects", "cube_s", "--num-envs", "3", "--trials", "1", "--env.scene.physics-hz", "120"]
    assert main(["evaluate", str(tmp_path / "policy"), *given, "--html", str(path)]) == 0
    assert "wrote" in capsys.readouterr().err
    text = path.read_text()
    assert not re.search(r"<script|<link|https?://|src=\"(?!data:)", text)
    for part in ("Of 3 throws, ", "cube_s", "Where throws come down", "never reached", "physics_hz"):
        assert part in text
    assert text.count("data:image/png") == 2
    strips = re.findall(r"<figcaption>(?:missed|caught)[^<]*throws?</figcaption><img [^>]*image/webp", text)
    assert text.count("data:image/webp") == len(strips) > 0
