"""Write throws in simulation, or the recording of a deployment, as a data set of LeRobot."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pixel2catch as p2c
from lerobot_format import (
    ACTION,
    AGE,
    DONE,
    REWARD,
    SEEN,
    STATE,
    SUCCESS,
    Episode,
    require_free_folder,
    write_dataset,
)

CAMERA = p2c.constants.RGB_CAMERA
TASK = "Catch the thrown object."  #: Task of an episode of a recording.
RUNS = (int(p2c.link.Mode.RAMP), int(p2c.link.Mode.RUN))  #: Modes in which the robot follows the policy.


def write_throws(
    folder: Path, policy: p2c.Policy, cfg: p2c.EvaluationCfg, *, images: bool
) -> tuple[int, int, int]:
    """Throw once in every environment, and write every trial until its decision.

    With `images`, the images of the robot's camera at the decisions are drawn, without latency.

    Returns:
        The number of throws, of catches, and of control steps.

    Raises:
        DeviceUnavailableError: Images cannot be drawn on this machine.
    """
    require_free_folder(folder)
    env, rows, seen = cfg.make_env(p2c.method_of(policy.contract)), list[list[Tensor]](), list[Tensor]()
    qpos = env.world.simulation.bind("qpos")

    def act(observations: dict[str, Tensor]) -> dict[str, Tensor]:
        now = env.measurement
        seen[:] = [each.cpu().clone() for each in (qpos, now.joint_pos, now.box, now.boxes.age)]
        return policy.act(observations)

    def watch(step, state) -> None:
        rewards = torch.stack([*step.rewards.values()]).sum(dim=0)
        made = (step.joint_pos_target, rewards, state.is_running & ~state.is_testing)
        rows.append([*seen, *(each.cpu().clone() for each in made)])

    try:
        actor: Any = SimpleNamespace(act=act, reset=policy.reset)
        record = p2c.run_round(env, actor, watch).record
        names = [env.world.objects.names[row] for row in record.object_id.tolist()]
    finally:
        env.close()

    def episode(row: int, name: str) -> Episode:
        positions, features = _features([torch.stack(each)[:, row] for each in zip(*rows, strict=True)])
        features[SUCCESS] = features[DONE] & bool(record.is_success[row])
        scene = replace(cfg.task.scene, visuals=True)
        return f"{TASK[:-1]}: {name}.", features, _drawn(positions, scene, name) if images else ()

    episodes = (episode(row, name) for row, name in enumerate(names))
    num_throws, num_steps = write_dataset(folder, env.workcell, episodes)
    return num_throws, int(record.is_success.sum()), num_steps


def _features(columns: list[Tensor]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return positions of the simulation, (num_steps, nq), and features of a throw until its decision."""
    qpos, joints, box, age, targets, rewards, is_open = columns
    count = int(is_open.sum()) + 1  # the last one is that of the decision
    pixels = p2c.pixel_features(torch.cat((box[:1], box[:-1])), box, CAMERA)
    features = {
        STATE: joints,
        SEEN: torch.cat((box, pixels), dim=1),
        AGE: age[:, :1],
        ACTION: targets,
        REWARD: rewards,
        DONE: torch.arange(len(box)) == count - 1,
    }
    return qpos[:count].numpy(), {name: each[:count].numpy() for name, each in features.items()}


def _drawn(qpos: np.ndarray, scene, object_name: str) -> Iterator[np.ndarray]:
    """Yield the images of the robot's camera at positions of the simulation, (num_steps, nq)."""
    with p2c.Renderer(p2c.build_model(scene, object_name), p2c.RGB_VIEW) as renderer:
        for positions in qpos:
            yield renderer.image(positions)


def write_recording(folder: Path, recording: Path, profile: p2c.Profile) -> tuple[int, int]:
    """Write the runs of a recorded deployment, with images if there are any; without rewards or success.

    The image of a step is the newest that had arrived at the decision.

    Returns:
        The number of runs, and of control steps.

    Raises:
        PerceptionError: It cannot be read.
        DeploymentError: The policy never ran in it.
    """
    servo, orders, boxes, images = _read(recording, profile)
    ticks = np.searchsorted(
        [tick.time for tick in servo], [order.target_stamp for _, order in orders], "right"
    )
    is_followed = np.array([False, *(tick.mode in RUNS for tick in servo)])  # before the first tick, too
    chosen = np.flatnonzero(is_followed[ticks]) if orders else []
    if not len(chosen):
        raise p2c.DeploymentError(
            f"{recording}: the policy decided nothing there while the robot followed it; name what 'deploy "
            "--record' or 'rehearse --record' wrote, of a throw at least."
        )
    if not boxes:
        raise p2c.DeploymentError(f"{recording}: has no boxes on {profile.operator.status.name}.")
    run = np.cumsum(~is_followed)[ticks[chosen]]  # it grows where a run ends
    is_first = np.diff(run, prepend=0) != 0
    times = [orders[row][0] for row in chosen]
    # The status with the box of a decision is recorded just after it.
    rows = np.minimum(np.searchsorted([time for time, _ in boxes], times), len(boxes) - 1)
    box = torch.from_numpy(np.array([boxes[row][1] for row in rows]))
    before = box[np.arange(len(run)) - ~is_first]
    columns = {
        STATE: np.array([servo[row - 1].joint_pos for row in ticks[chosen]]),
        ACTION: np.array([orders[row][1].joint_pos_target for row in chosen]),
        SEEN: torch.cat((box, p2c.pixel_features(before, box, CAMERA)), dim=1).numpy(),
        DONE: np.append(is_first[1:], True),
    }
    pictures = _recorded(recording, profile, np.searchsorted(images, times, side="right") - 1)
    episodes = (
        (TASK, {name: values[begin:end] for name, values in columns.items()}, islice(pictures, end - begin))
        for begin, end in pairwise([*np.flatnonzero(is_first).tolist(), len(run)])
    )
    return write_dataset(folder, p2c.find_workcell(profile.workcell), episodes)


def _read(
    recording: Path, profile: p2c.Profile
) -> tuple[
    list[p2c.link.Command],
    list[tuple[float, p2c.link.JointTargets]],
    list[tuple[float, np.ndarray]],
    list[float],
]:
    """Ticks of the servo, decisions, boxes and the times of the images, each with the recorder's time [s]."""
    servo, orders, boxes, images = [], [], [], []
    with p2c.opened_bag(recording, extra="deployment") as reader:
        for connection, nanoseconds, data in reader.messages():
            time, topic = 1e-9 * nanoseconds, connection.topic
            if topic == p2c.recorder.SERVO.name:
                servo.append(p2c.link.Command.of(p2c.messages.read_float_array(data)))
            elif topic == p2c.recorder.TARGETS.name:
                orders.append((time, p2c.link.JointTargets.of(p2c.messages.read_float_array(data))))
            elif topic == profile.operator.status.name:
                box = p2c.messages.read_json(data)["box"]
                if box is not None or boxes:
                    boxes.append((time, boxes[-1][1] if box is None else np.array(box)))
            elif topic in _image_topics(profile):
                images.append(time)
    return servo, orders, boxes, images


def _image_topics(profile: p2c.Profile) -> tuple[str, ...]:
    topic = profile.camera.image
    return (topic.name, p2c.messages.compressed_topic(topic).name)


def _recorded(recording: Path, profile: p2c.Profile, wanted: np.ndarray) -> Iterator[np.ndarray]:
    """Yield images by their numbers, which never fall: the last good one where one is damaged."""
    if wanted.max() < 0:  # there are none
        return
    row, picture = 0, None
    with p2c.opened_bag(recording, extra="deployment") as reader:
        topics = [each for each in reader.connections if each.topic in _image_topics(profile)]
        for number, (connection, _, data) in enumerate(reader.messages(topics)):
            if number in wanted or picture is None:
                with suppress(p2c.DeploymentError):
                    is_raw = connection.msgtype == p2c.messages.IMAGE
                    raw = bytes(data) if is_raw else p2c.messages.uncompress(bytes(data))
                    picture = p2c.messages.read_image(raw).pixels
            while picture is not None and row < len(wanted) and wanted[row] <= number:
                yield picture
                row += 1
    if picture is None:
        raise p2c.DeploymentError(f"{recording}: no image can be read.")


def main() -> None:
    """Write the data set, and print its size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "source", type=Path, nargs="?", help="a policy as for 'evaluate', or a recording of 'deploy'"
    )
    parser.add_argument("--out", type=Path, required=True, help="new folder of the data set")
    parser.add_argument("--throws", type=int, default=100, help="throws in simulation (default: 100)")
    parser.add_argument("--objects", nargs="+", default=p2c.SEEN, help="names of objects (default: seen)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the throws (default: 0)")
    parser.add_argument("--images", action="store_true", help="draw the camera's images of the throws")
    parser.add_argument("--profile", default="ur5e_allegro_v4", help="profile of the recorded robot")
    args = parser.parse_args()
    try:
        if args.source is not None and p2c.is_bag(args.source):
            counts = write_recording(args.out, args.source, p2c.Profile.load(args.profile))
            print("{} runs of the policy, {} control steps".format(*counts))
            return
        policy = p2c.load_policy(args.source)
        cfg = p2c.EvaluationCfg(
            objects=tuple(args.objects), num_envs=args.throws, seed=args.seed, task=p2c.task_of(policy)
        )
        counts = write_throws(args.out, policy, cfg, images=args.images)
        print("{} throws, {} caught; {} control steps".format(*counts))
    except (p2c.Pixel2CatchError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
