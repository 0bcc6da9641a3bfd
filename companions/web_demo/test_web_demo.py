"""The page's folder, and its JavaScript against the Python code, step by step in node."""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from export import LIBRARIES, main, write_web_demo
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.episode import Episode
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.methods import find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.objects import SEEN
from pixel2catch.workcells import find_workcell

ROOT = Path(__file__).parents[2]
PATIENCE = 600.0  #: Longest time for a process to end on a busy machine [s].
PACKAGES = Path(os.environ.get("PIXEL2CATCH_NODE_MODULES", ROOT / "node_modules")).resolve()
"""Where npm has put the page's packages, for the tests that run it."""

CHROMIUM = shutil.which("chromium")
BROWSER_ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)

needs_packages = pytest.mark.skipif(
    not ((PACKAGES / "three").is_dir() and shutil.which("node")),
    reason="needs node and, in node_modules, the packages of the page's package.json",
)
NUM_THROWS, NUM_STEPS = 3, 50


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("demo"), None)


def exported(folder: Path, policy: str | None) -> Path:
    """The page of a policy, with npm's packages where there are any."""
    if PACKAGES.is_dir():
        (folder / "node_modules").symlink_to(PACKAGES)
    write_web_demo(policy, folder)
    return folder


def test_the_command_names_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "argv", ["export.py", str(tmp_path / "web"), "--policy", "proposed"])
    main()
    main()  # over an earlier page
    printed = capsys.readouterr()
    assert "npm install --prefix" in printed.err
    assert "@mujoco/mujoco@3.14.0 three@0.187.0" in printed.err
    files = {path.relative_to(tmp_path / "web").as_posix() for path in (tmp_path / "web").rglob("*.*")}
    assert {"index.html", "main.js", "task.json", "policy/policy.json", "scenes/cube_s.xml"} <= files


def test_the_documents_name_the_pinned_packages(demo: Path):
    versions = json.loads((demo / "package.json").read_text())["dependencies"]
    packages = " ".join(f"{name}@{version}" for name, version in versions.items())
    for name in ("docs/web_demo.md", "companions/web_demo/README.md", "CONTRIBUTING.md"):
        found = re.findall(r"npm install .*?--prefix \S+ ([^`\n]+)", (ROOT / name).read_text("utf-8"))
        assert set(found) == {packages}


def test_a_folder_with_anything_else_is_refused(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match="not of the page"):
        write_web_demo(None, tmp_path)


def test_only_packages_of_the_pinned_versions_are_bundled(tmp_path: Path):
    for package, version in (("@mujoco/mujoco", "3.14.0"), ("three", "0.1.0")):
        folder = tmp_path / "node_modules" / package
        for file in LIBRARIES[package]:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text("")
        (folder / "package.json").write_text(json.dumps({"version": version}))
    assert write_web_demo(None, tmp_path) == ("three@0.187.0",)
    assert {path.name for path in (tmp_path / "lib").iterdir()} == {"mujoco.js", "mujoco.wasm"}


@pytest.mark.parametrize(
    ("method", "workcell", "message"),
    [
        ("proposed", "two_ur5e_allegro", "2 palms"),
        ("catch_teacher+age", "ur5e_allegro", "object_position"),
        ("only_center+fit", "ur5e_allegro", "box_fit"),
        ("proposed", "fr3_allegro", "limits of acceleration"),
    ],
)
def test_what_the_page_cannot_run_is_refused(tmp_path: Path, method: str, workcell: str, message: str):
    cell = find_workcell(workcell)
    policy = Policy(contract_of(find_method(method, cell), cell), hidden=(8,))
    policy.save(tmp_path / "policy")
    with pytest.raises(ValueError, match=message):
        write_web_demo(str(tmp_path / "policy"), tmp_path / "web")
    assert not (tmp_path / "web").exists()


def quiet_throws(policy_name: str | None) -> dict[str, Any]:
    """Throws without noise by the Python code: what was drawn, and every step."""
    policy, method = load_policy(Path(policy_name) if policy_name else None)
    task = task_of(policy)
    quiet = replace(
        task,
        objects=SEEN,
        episode=EpisodeCfg(max_steps=NUM_STEPS + 1, rest_steps=NUM_STEPS),
        randomization=replace(task.randomization, action_noise=0.0, action_bias=0.0),
        sensing=replace(task.sensing, corner_noise=0.0, joint_noise=0.0, joint_bias=0.0),
    )
    env = CatchEnv(quiet, method, num_envs=NUM_THROWS, seed=3)
    observation = env.reset()
    episodes = drawn(env.episode, env.world.objects.names)
    steps = []
    for _ in range(NUM_STEPS):
        actions = policy.act(observation.policy)
        inputs = {name: value.tolist() for name, value in observation.policy.items()}
        step = env.step(actions)
        observation = step.observation
        steps.append(
            {
                "observations": inputs,
                "actions": {name: value.tolist() for name, value in actions.items()},
                "target": step.joint_pos_target.tolist(),
                "qpos": env.world.simulation.bind("qpos").tolist(),
                "is_touched": step.record.is_hand_contact.tolist(),
                "is_success": step.record.is_success.tolist(),
            }
        )
    return {"episodes": episodes, "steps": steps}


def drawn(episode: Episode, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """What was drawn for each throw; latencies are whole control steps."""
    parameters = vars(episode.parameters) | {"latency": episode.parameters.latency.long()}
    return [
        {name: value[i].tolist() for name, value in parameters.items()}
        | {"object": names[int(parameters["object_id"][i])]}
        | {"throw": {name: value[i].tolist() for name, value in vars(episode.throw).items()}}
        for i in range(NUM_THROWS)
    ]


@needs_packages
@pytest.mark.parametrize("policy", [None, "proposed"])
def test_javascript_and_python_agree(demo: Path, tmp_path: Path, policy: str | None):
    """On the states of the Python code to float32, and freely until the hand touches the object."""
    folder = exported(tmp_path, policy) if policy else demo
    (tmp_path / "throws.json").write_text(json.dumps(quiet_throws(policy)))
    command = ["node", Path(__file__).with_name("agreement.mjs"), folder, tmp_path / "throws.json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert max(result["forced"].values()) < 1e-4
    assert max(result["free"].values()) < 1e-4
    assert result["num_steps_free"] > 20 * NUM_THROWS


@needs_packages
@pytest.mark.slow
def test_a_throw_with_the_mouse_is_caught(demo: Path):
    with open_page(demo) as page:
        page.wait_for_function("window.pixel2catch")
        page.select_option("#object", "sphere_l")
        start, end = page.evaluate(DRAG)
        page.mouse.move(*start)
        page.mouse.down()
        page.mouse.move(*end, steps=3)
        page.mouse.up()
        page.wait_for_function("document.querySelector('#yours').cells[1].textContent === '1'")
        assert page.inner_text("#yours").split() == ["yours", "1", "1", "100", "%"]


@pytest.mark.slow
def test_the_page_says_that_its_libraries_are_missing(demo: Path, tmp_path: Path):
    shutil.copytree(demo, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("lib", "node_modules"))
    with open_page(tmp_path) as page:
        page.wait_for_function("document.querySelector('#hint').textContent.includes('libraries')")


DRAG = """async () => {
  const { launchVelocity } = await import("./episode.js");
  const { aiming, view, demo, episode } = window.pixel2catch;
  const from = episode.throw.pos;
  const velocity = launchVelocity(demo.task.physics.gravity, from, aiming.catchCenter(), 1.75);
  const pixel = (point) => {
    const place = aiming.position.clone().set(...point).project(view.outside);
    return [((place.x + 1) / 2) * innerWidth, ((1 - place.y) / 2) * innerHeight];
  };
  return [pixel(from), pixel(from.map((value, k) => value + velocity[k] / 5))];
}"""
"""Where on the screen a drag begins and ends that throws into the middle of the catch area."""


@contextmanager
def open_page(folder: Path) -> Iterator[Any]:
    """The page in headless Chromium, from a file server."""
    playwright = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM:
        pytest.skip("needs Chromium")
    handler = partial(QuietHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, playwright.sync_playwright() as p:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        browser = p.chromium.launch(executable_path=CHROMIUM, args=[*BROWSER_ARGUMENTS])
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.set_default_timeout(300_000.0)
            errors = list[Any]()
            page.on("pageerror", lambda error: errors.append(error))
            page.goto(f"http://127.0.0.1:{server.server_port}/")
            yield page
            assert not errors
        finally:
            browser.close()
            server.shutdown()
            thread.join()


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass
