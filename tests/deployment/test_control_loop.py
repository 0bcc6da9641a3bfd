"""The control loop between camera, servo and operator, in memory."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
import torch
from loop_lab import BOX, HOME, PROFILE, Surroundings, forgetting, new_pipeline, picture, remembering
from servo_rows import LIMITS

from domains import PATIENCE
from pixel2catch.deployment import recorder
from pixel2catch.deployment.control_loop import GRACE, SHIFT, SILENCE, ControlLoop, DecisionTimer
from pixel2catch.deployment.paths import Motion, PathFinder
from pixel2catch.deployment.policy_pipeline import FADE_STEPS, PolicyController
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
from pixel2catch.deployment.throw_cycle import ThrowCycle
from pixel2catch.errors import DeploymentError
from pixel2catch.mdp.control_step import BoxHistory
from pixel2catch.ros2 import messages
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.link import Fault, Mode


class LoopBench:
    def __init__(
        self,
        around: Surroundings,
        perception_time: Callable[[], float] = float,
        controller: PolicyController | None = None,
        place: str | None = None,
    ) -> None:
        self.around, pipeline = around, new_pipeline(controller=controller)
        self.loop = ControlLoop(
            pipeline,
            RGB_CAMERA,
            around.connection,
            PROFILE,
            perception_time=perception_time,
            cycle=ThrowCycle(pipeline, PROFILE, LIMITS, RGB_CAMERA, place) if place else None,
        )
        self._prompts = around.lab.publisher(PROFILE.operator.prompt)

    def point(self, text: str = json.dumps({"box": BOX})) -> None:
        self._prompts.publish(messages.text(text))

    def step(self) -> dict[str, Any]:
        statuses = list[dict[str, Any]]()
        self.loop.run(lambda: bool(statuses), statuses.append)
        return statuses[0]


@pytest.fixture
def bench(around: Surroundings) -> LoopBench:
    return LoopBench(around)


def test_from_the_prompt_on_every_step_gives_targets_and_a_status(bench: LoopBench, around: Surroundings):
    """Without a new image, too; then the step counts as missed."""
    statuses = around.lab.subscription(PROFILE.operator.status, 100)
    around.tick(Mode.ARMED)
    around.show(picture(), age=0.02)
    assert bench.step()["verdict"] == "no prompt"
    assert around.servo.receive() == []
    bench.point()
    taken = around.show(picture(), age=0.02)
    status = bench.step()
    *_, first = around.servo.receive()
    assert first.image_stamp == pytest.approx(taken, abs=0.01)
    assert (status["mode"], status["box"]) == ("armed", list(BOX))
    sent = [json.loads(messages.read_text(message.data)) for message in statuses.take()]
    assert sent[-1] == status
    bench.step()
    *_, second = around.servo.receive()
    assert second.target_stamp > first.target_stamp
    assert second.image_stamp == first.image_stamp
    assert (bench.loop.statistics.num_steps, bench.loop.statistics.num_missed) == (3, 1)


def test_a_camera_without_images_is_reported(bench: LoopBench, around: Surroundings):
    """Before the first image, and a second after the last."""
    around.tick(Mode.IDLE)
    assert bench.step()["verdict"] == "no image"
    around.show(picture())
    while bench.step()["verdict"] != "no prompt":
        pass
    begin = around.clock.now()
    around.clock.sleep_until(begin + SILENCE - 3.0 * CONTROL_DT)
    assert bench.step()["verdict"] == "no prompt"
    around.clock.sleep_until(begin + SILENCE)
    assert bench.step()["verdict"] == "no image"


def test_arming_begins_a_new_throw(bench: LoopBench, around: Surroundings):
    around.show(picture())
    bench.point()
    around.tick(Mode.IDLE)
    assert bench.step()["box"] is not None
    around.tick(Mode.ARMED)
    around.show(picture())
    assert bench.step()["box"] is None


def test_the_policy_gets_the_joints_as_they_are_after_the_perception(around: Surroundings):
    """A tick of the servo during the perception counts."""
    moved = HOME + 0.02
    expected = forgetting().step(
        torch.tensor(moved[None], dtype=torch.float32),
        BoxHistory.begun(torch.tensor([BOX]), torch.tensor([1.8]), 1),
    )
    bench = LoopBench(around, lambda: 0.01)
    around.tick(Mode.ARMED)
    bench.point()
    around.show(picture())
    bench.loop.poll()
    around.tick(Mode.ARMED, joint_pos=moved)
    while not (sent := around.servo.receive()):
        bench.step()
    assert sent[0].joint_pos_target == pytest.approx(expected[0].numpy(), abs=1e-6)


def film(bench: LoopBench, num_images: int) -> Iterator[float]:
    """Poll every millisecond, with 30 images a second of an age of 15 ms; yield the time [s]."""
    around, begin = bench.around, bench.around.clock.now()
    around.tick(Mode.ARMED)
    bench.point()
    for tick in range(round(1e3 * num_images * CONTROL_DT)):
        around.clock.sleep_until(begin + 1e-3 * tick)
        if tick % 100 in (0, 33, 67):
            around.show(picture(), age=0.015)
        bench.loop.poll()
        yield around.clock.now()


@pytest.mark.parametrize(("took", "missed"), [(0.025, 0.0), (0.06, 0.5)])
def test_the_servo_gets_the_stamp_of_an_image_at_once(around: Surroundings, took: float, missed: float):
    """However long perception takes. The policy decides at 30 Hz, also if every second image is skipped."""
    bench = LoopBench(around, lambda: took, remembering())
    newest, ages, made = 0.0, list[float](), list[float]()
    for now in film(bench, 50):
        for targets in around.servo.receive():
            newest = targets.image_stamp
            made.append(targets.target_stamp)
        ages.append(now - newest)
    assert 0.015 < max(ages[len(ages) // 2 :]) < 0.015 + CONTROL_DT + 0.004
    gaps = np.diff(np.unique(made)[10:])
    assert gaps.mean() == pytest.approx(CONTROL_DT, rel=0.01)
    assert np.abs(gaps - CONTROL_DT).max() <= GRACE + SHIFT + 0.003
    statistics = bench.loop.statistics
    assert statistics.num_missed / statistics.num_steps == pytest.approx(missed, abs=0.1)


def test_images_are_processed_while_a_path_is_searched(around: Surroundings, monkeypatch: pytest.MonkeyPatch):
    """Meanwhile the robot rests. Then it moves."""
    bench, begun, may_end = LoopBench(around, place="side"), Event(), Event()

    def slow_search(_: PathFinder, *ends: np.ndarray) -> Motion:
        begun.set()
        assert may_end.wait(PATIENCE)
        return Motion.along(np.array(ends), np.ones(len(HOME)))

    def steps(number: int) -> list[dict[str, Any]]:
        around.servo.receive()
        return [(around.show(picture()), bench.step())[1] for _ in range(number)]

    monkeypatch.setattr(PathFinder, "motion", slow_search)
    around.tick(Mode.ARMED, joint_pos=HOME + 0.5 * (np.arange(len(HOME)) == 0))
    steps(FADE_STEPS + 2)
    assert begun.wait(PATIENCE)
    num_missed = bench.loop.statistics.num_missed
    assert {status["cycle"] for status in steps(30)} == {"move"}
    assert bench.loop.statistics.num_missed == num_missed
    assert np.ptp([sent.joint_pos_target for sent in around.servo.receive()], axis=0).max() == 0.0
    may_end.set()
    while not steps(1)[0]["message"].startswith("to the start pose"):
        pass


def test_stops_and_refusals_are_reported_once_and_counted(bench: LoopBench, around: Surroundings):
    """The sender of a stop request is named until the robot is armed again."""
    around.tick(Mode.RUN)
    around.broker.node(around.clock).publisher(PROFILE.operator.stop).publish(messages.boolean(True))
    for refused in (0, Fault.START_POSE, 0):
        around.tick(Mode.STOPPED, stopped_by=Fault.DEAD_MAN | Fault.IMAGE_STALE, refused=refused)
    first, second = bench.step(), bench.step()
    assert first["stopped_by"] == second["stopped_by"] == ["image stale", "dead man"]
    assert (first["refused"], second["refused"]) == (["start pose"], [])
    assert all("requested by publisher" in status["message"] for status in (first, second))
    summary = bench.loop.statistics.summary()
    assert summary["stops"] == {"image stale, dead man": 1}
    assert summary["refusals"] == {"start pose": 1}
    around.tick(Mode.ARMED)
    assert "requested by" not in bench.step()["message"]


def test_an_incomplete_recording_and_a_servo_that_has_ended_are_reported(
    around: Surroundings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(recorder, "MOST_WAITING", 0)
    with BagRecorder(tmp_path / "tape") as bag:
        recording = DeploymentRecorder(bag, around.connection.transport, PROFILE, around.clock, "raw")
        bench = LoopBench(replace(around, connection=replace(around.connection, recording=recording)))
        around.tick(Mode.RUN)
        bench.point("{}")
        message = bench.step()["message"]
        assert "a prompt is not" in message
        assert "the recording lacks" in message
        around.servo.close()
        with pytest.raises(DeploymentError, match="press its stop"):
            bench.step()


def test_the_latency_is_from_the_image_to_the_first_command_with_it(bench: LoopBench, around: Surroundings):
    now = around.clock.now()
    for tick in range(4):
        late = now + 0.004 * (tick // 2)
        around.tick(Mode.RUN, time=now + 0.002 * tick, target_stamp=late, image_stamp=now - 0.02)
    bench.step()
    latency = bench.loop.statistics.summary()["image_to_command_ms"]
    assert latency["count"] == 1
    assert latency["p50"] == pytest.approx(24.0, abs=1e-6)


def decided(timer: DecisionTimer, ends: list[tuple[float, float]], until: float, step: float) -> np.ndarray:
    """Times of decisions by a loop with this step, given exposure and end of each perception [s]."""
    waiting, times, now = list(ends), list[float](), 0.0
    while now < until:
        now += step
        while waiting and waiting[0][1] <= now:
            timer.learn(waiting[0][0], now)
            waiting.pop(0)
        if now >= timer.due:
            times.append(now)
            timer.advance(now, is_even=True)
    return np.array(times)


@pytest.mark.parametrize(("least", "jitter", "every"), [(0.02, 0.01, 1), (0.075, 0.01, 2)])
def test_decisions_are_even_and_follow_most_results_at_once(least: float, jitter: float, every: int):
    """Whether perception takes less than a control step, or more and skips every second image."""
    stamps = every * CONTROL_DT * np.arange(300)
    ends = stamps + least + np.random.default_rng(0).uniform(0.0, jitter, len(stamps))
    times = decided(DecisionTimer(0.01), list(zip(stamps, ends, strict=True)), stamps[-1], 1e-4)
    gaps = np.diff(times[100:])
    assert len(times) == pytest.approx(stamps[-1] / CONTROL_DT, abs=2)
    assert gaps.mean() == pytest.approx(CONTROL_DT, rel=2e-3)
    assert np.abs(gaps - CONTROL_DT).max() < SHIFT + 2e-4
    later = [times[times >= end].min() - end for end in ends[150:-10]]
    assert np.quantile(later, 0.8) < jitter + 3e-3


def test_a_decision_waits_for_an_expected_result_but_not_for_long():
    timer, age = DecisionTimer(0.0), 0.02
    for number in range(60):
        timer.learn(number * CONTROL_DT, number * CONTROL_DT + age)
    timer.advance(59 * CONTROL_DT + age, is_even=False)
    due, stamp = timer.due, timer.due - age
    assert timer.is_due(due, None)
    assert not timer.is_due(due + 0.9 * GRACE, stamp)
    assert timer.is_due(due + GRACE, stamp)
    assert timer.is_due(due, stamp + 0.5 * CONTROL_DT)  # too young to be expected


def test_late_decisions_are_skipped_and_the_first_step_may_have_any_length():
    timer = DecisionTimer(1.0)
    timer.advance(1.001, is_even=False)
    assert timer.due == pytest.approx(1.0 + CONTROL_DT)
    timer.advance(1.0 + 3.5 * CONTROL_DT, is_even=True)
    assert timer.due == pytest.approx(1.0 + 4.0 * CONTROL_DT, abs=SHIFT)
    timer = DecisionTimer(1.0)
    timer.learn(0.99, 1.005)
    timer.advance(1.0, is_even=False)
    assert timer.due == pytest.approx(1.005 + CONTROL_DT, abs=1e-6)
