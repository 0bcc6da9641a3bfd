"""The throws of `pixel2catch trials`: each is taken, measured, shown in pictures, and judged."""

import json
import os
import select
import shlex
import signal
import sys
import termios
import tty
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from typing import Any

import numpy as np

from pixel2catch.camera.image import Pixels
from pixel2catch.checks import require_valid
from pixel2catch.cli.console import prepare, say, saying_changes
from pixel2catch.cli.deploy import make_pipeline
from pixel2catch.cli.main import parse_options
from pixel2catch.cli.rehearse import Rehearse
from pixel2catch.deployment.operator import ANSWERS, NOTHING, newest
from pixel2catch.deployment.replay import measure
from pixel2catch.errors import DeploymentError, InvalidValueError, PerceptionError
from pixel2catch.evaluation.grid import Json
from pixel2catch.evaluation.loading import fingerprint, load_policy
from pixel2catch.evaluation.report import Row
from pixel2catch.evaluation.trials import REPEAT, draw_plan, folder_of, write_throw
from pixel2catch.files import json_object
from pixel2catch.rendering.video import draw_box, write_film
from pixel2catch.ros2 import messages
from pixel2catch.scene.objects import OBJECTS, select_objects
from pixel2catch.servo.status_words import sentence
from pixel2catch.twin.rehearsal import run_trial
from pixel2catch.twin.stepped import in_step

KEYS = {"c": "caught", "r": "reached", "d": "dropped", "x": REPEAT}  #: Outcomes by key; Enter confirms.
NUM_PICTURES = 6  #: Number of pictures in a strip.


def new_plan(cfg: Mapping[str, Any]) -> Json:
    """Return configuration and throws for fields of `Trials`; refuse unknown objects, and a policy twice."""
    names = [f"real_{name}" if f"real_{name}" in OBJECTS else name for name in cfg["objects"]]
    policies = {str(path): fingerprint(path) for path in cfg["policies"]}
    if len({*policies.values()}) < len(cfg["policies"]):
        raise InvalidValueError(f"--policies {' '.join(policies)} has one twice; name each once.")
    options = {name: cfg[name] for name in ("throws", "seed", "deploy", "rehearse")}
    options |= {"objects": [*select_objects(names)], "policies": policies}
    throws = draw_plan(options["objects"], [*policies], cfg["throws"], cfg["seed"])
    return {"configuration": options, "throws": [*throws]}


class TrialSeries:
    """Takes throws with a robot, or with its digital twin."""

    def __init__(self, cfg: Mapping[str, Any]) -> None:
        """Read the fields of `Trials`; refuse invalid options, and a policy that does not fit the robot."""
        try:
            options, rehearsed = shlex.split(cfg["deploy"]), shlex.split(cfg["rehearse"])
        except ValueError as error:
            raise InvalidValueError(f"--deploy or --rehearse: {error}; correct its quotes.") from error
        self._cfg, self._deploy = cfg, parse_options("deploy", options)
        rehearse: Rehearse = parse_options("rehearse", rehearsed)
        for each in (self._deploy, rehearse):
            require_valid(each)
        self._rehearsal = rehearse.rehearsal
        self._profile, self._camera = self._deploy.link.robot.load(), self._deploy.perception.camera_spec([])
        if rehearsed and self._rehearsal.task.camera != self._deploy.perception.camera:
            raise InvalidValueError("give --deploy and --rehearse the same --camera.")
        places = self._profile.places
        self._place = self._deploy.after_catch or (next(iter(places)) if len(places) == 1 else "")
        if self._place not in places:
            given = ", ".join(places) or "none; add one"
            raise InvalidValueError(f"give a place of the profile, --deploy='--after-catch PLACE': {given}.")
        place = [] if self._deploy.after_catch else ["--after-catch", self._place]
        self._options = [*options, *place, "--json", "--record"]
        for path in cfg["policies"]:
            make_pipeline(self._deploy.perception, path, self._profile, self._camera, is_live=False)

    def take(self, throw: Row) -> None:
        """Take a throw, unless it is recorded; measure it, ask for its outcome, and write its row."""
        folder, outcome, found, pictures = folder_of(self._cfg["out"], throw), "", {"proposed": REPEAT}, []
        name, recording = f"throw {throw['number']}, {throw['object']}", folder / "recording"
        if is_new := not recording.exists():
            folder.mkdir(parents=True, exist_ok=True)
            if self._cfg["rehearse"]:
                outcome = self._rehearse(throw, recording)
            else:
                self._run_deploy(name, [throw["policy"], *self._options, str(recording)], folder)
        try:
            found, pictures = measure(recording, self._profile, self._camera)
        except (DeploymentError, PerceptionError) as error:
            say(str(error))
        if pictures:
            write_film(folder / "strip.png", [_strip(pictures)], fps=1)
        if not is_new and (self._cfg["rehearse"] or found["proposed"] == REPEAT):
            outcome = REPEAT  # it was interrupted in the twin, or before its flight
        outcome = outcome or self._ask(f"{name}: {found['proposed']}?", found)
        write_throw(self._cfg["out"], {**throw, **found, "outcome": outcome})
        say(f"{name}: {outcome}")

    def _rehearse(self, throw: Row, recording: Path) -> str:
        """Let the digital twin throw, the same to all policies of a block; return the true outcome."""
        prepare("cpu")
        seed = self._cfg["seed"] + throw["block"]
        cfg = replace(self._rehearsal, after_catch=self._place, record=recording, seed=seed)
        policy, _ = load_policy(Path(throw["policy"]))
        task = replace(cfg.task, objects=(throw["object"],)).make(policy, seed)
        with in_step(cfg, task, policy) as (twin, _):
            outcome = run_trial(twin.operator, seed, cfg.held_seconds, is_cycle=True)
        if outcome.problem:
            raise DeploymentError(f"throw {throw['number']} did not begin: {outcome.problem}")
        return "caught" if outcome.is_success else "reached" if outcome.is_tracked else "dropped"

    def _run_deploy(self, name: str, args: Sequence[str], folder: Path) -> None:
        """Let `deploy` take a throw, until the robot waits again or was stopped."""
        hear, has_begun, log = saying_changes(), False, folder / "deploy.txt"
        command = [sys.executable, "-m", "pixel2catch", "deploy", *args]
        with open(log, "wb") as file, Popen(command, stdin=DEVNULL, stdout=PIPE, stderr=file) as process:
            for line in process.stdout or ():
                status = json_object(line.decode())
                hear(f"{name}: {sentence(status)}")
                has_begun |= status.get("cycle") == "throw"
                if has_begun and (status.get("cycle") == "wait" or status.get("mode") == "stopped"):
                    process.send_signal(signal.SIGINT)
                    break
            process.wait()
        last = " ".join(log.read_text(errors="replace").strip().splitlines()[-1:])
        if not has_begun:
            raise DeploymentError(f"'pixel2catch deploy' ended before a throw: {last}")
        if process.returncode:
            say(f"{name}: {last}")

    def _ask(self, question: str, found: Row) -> str:
        """Ask for an outcome, at this terminal and on the operator's page."""
        file, topics = sys.stdin.fileno(), self._profile.operator
        stops = ", ".join(found.get("stopped_by", ()))
        status = messages.text(json.dumps({**NOTHING, "mode": question, "message": stops, "is_asking": True}))
        with ExitStack() as stack:
            if os.isatty(file):
                stack.callback(termios.tcsetattr, file, termios.TCSADRAIN, termios.tcgetattr(file))
                tty.setcbreak(file, termios.TCSAFLUSH)
            say("Enter confirms; c: caught, r: reached, d: dropped, x: repeat the throw")
            node, _ = stack.enter_context(self._deploy.link.join("pixel2catch_trials", question))
            page, answers = node.publisher(topics.status), node.subscription(topics.prompt, depth=16)
            while True:
                page.publish(status)
                node.wait(0.1)
                is_pressed, *_ = select.select([file], [], [], 0.0)
                keys = os.read(file, 64).decode(errors="replace") if is_pressed else ""
                given = [found["proposed"] if key == "\n" else KEYS.get(key) for key in keys]
                given.append(newest(answers.take(), {}).get("answer"))
                if answer := next((each for each in given if each in ANSWERS), None):
                    return answer


def _strip(pictures: Sequence[tuple[Pixels, list[float] | None]]) -> Pixels:
    """Return some pictures of a flight side by side, half as large, with the object's boxes."""
    drawn = list[Pixels]()
    for place in np.linspace(0, len(pictures) - 1, NUM_PICTURES).round().astype(int):
        pixels, box = pictures[place]
        if box:
            draw_box(pixels := pixels.copy(), np.array(box))
        drawn.append(pixels[::2, ::2])
    return np.concatenate(drawn, axis=1)
