"""The files of the package between an image of the camera and its command to the robot."""

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from paths import BUDGETS, FileCounter
from pixel2catch.deployment.control_loop import ControlLoop, StepClock, SteppedServo
from pixel2catch.evaluation.loading import task_of
from pixel2catch.policy import Policy
from pixel2catch.shipped import policy_folder
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.rehearsal import RehearsalOperator, run_trial
from pixel2catch.twin.stepped import in_step

NUM_LOOKS = 40
"""Looks of the control loop that are counted, 2 to 3 control steps: images arrive, commands are sent."""


def test_an_image_passes_few_files_on_its_way_to_a_command(monkeypatch: pytest.MonkeyPatch, opengl: None):
    policy = Policy.load(policy_folder(Path("proposed")))
    counter, looks, operators = FileCounter(), list[None](), list[RehearsalOperator]()

    def is_watched() -> bool:
        is_flying = any((each.phase, each.mode) == ("flying", "run") for each in operators)
        return is_flying and len(looks) < NUM_LOOKS

    def counted(method: Callable[..., Any], *, on: bool) -> Callable[..., Any]:
        @wraps(method)
        def call(*args: Any) -> Any:
            is_on = is_watched()
            looks.extend([None] * (is_on and method.__name__ == "poll"))
            with counter.switched(on=on and is_on):
                return method(*args)

        return call

    monkeypatch.setattr(ControlLoop, "poll", counted(ControlLoop.poll, on=True))
    monkeypatch.setattr(SteppedServo, "tick", counted(SteppedServo.tick, on=True))
    monkeypatch.setattr(StepClock, "sleep_until", counted(StepClock.sleep_until, on=False))
    cfg = RehearsalCfg(throws=1, seed=3)
    with in_step(cfg, task_of(policy, physics_hz=120.0), policy) as (twin, _):
        operators.append(twin.operator)
        outcome = run_trial(twin.operator, cfg.seed)
    files = counter.files()
    assert outcome.is_success
    assert len(looks) == NUM_LOOKS
    assert {"perception/background.py", "policy/policy.py", "servo/tick.py"} <= files
    assert len(files) <= BUDGETS["whole"]["files_from_image_to_command"], "\n".join(sorted(files))
