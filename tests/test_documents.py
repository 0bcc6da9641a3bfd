"""What documents say is true: commands, messages and links; figures and notebook are made anew."""

import ast
import json
import re
import runpy
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.main import parse
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.learning import experiment
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.own_files import VARIABLE, take_option
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.shipped import policy_folder
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures"
LARGEST_FIGURE = 200_000  #: Size of a figure at the most [bytes].

PAGES = (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))
EXAMPLES = tuple(ROOT.glob("examples/*.py"))
INPUTS = {".csv", ".json", ".mp4", ".npz", ".onnx", ".py", ".yaml"}  #: Endings of files that commands read.


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[str]:
    return re.findall(r"^ *(?:torchrun .* -m (?:-- )?)?(pixel2catch .*)$", text, re.MULTILINE)


COMMANDS = {line: page.name for page in PAGES for line in commands("".join(blocks(page, "sh")))}
COMMANDS |= {line: script.name for script in EXAMPLES for line in commands(script.read_text("utf-8"))}


def test_results_name_no_machine():
    results = (ROOT / "experiments" / "results").rglob("*.json")
    private = re.compile(r'"/(?:home|root|tmp|work)/')
    assert [path.name for path in results if private.search(path.read_text("utf-8"))] == []


def test_links_lead_somewhere():
    made = {"catching.md", "api.md", "mdp.md"}  # from the notebook and the docstrings
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)#:]+)\)", text):
            is_there = (page.parent / target).exists() or Path(target).name in made
            assert is_there, f"{page.relative_to(ROOT)}: {target}"


WRITTEN = {"--camera": CameraFile(camera=RGB_CAMERA).save, "--dynamics": DynamicsFile().save}
"""What writes a file of its kind for an option; files of others may be empty."""


@pytest.mark.parametrize("line", COMMANDS, ids=[f"{page}: {line[12:50]}" for line, page in COMMANDS.items()])
def test_commands_are_understood(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Options and their kinds are right; what the commands do is tested where they are."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.setattr(experiment, "policy_folder", lambda _: policy_folder(None))  # of --start
    monkeypatch.setattr(experiment, "find_workcell", lambda _: UR5E_ALLEGRO)  # of --workcell FILE.py
    args = take_option(shlex.split(line, comments=True)[1:])
    monkeypatch.setenv(VARIABLE, "")  # files of one's own are not there
    for option, argument in zip(["", *args], args, strict=False):
        path = Path(argument)
        if option != "--out" and path.suffix in INPUTS:
            path.parent.mkdir(parents=True, exist_ok=True)
            WRITTEN.get(option, Path.touch)(path)
        elif option != "--out" and "/" in argument and not path.is_absolute():
            path.mkdir(parents=True, exist_ok=True)
            (path / "policy.json").touch()
    parse(args)


@pytest.mark.usefixtures("small_cells")
def test_python_in_documents_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    pages = (ROOT / "docs" / "python.md", *ROOT.glob("docs/extending/*.md"))
    found = [block for page in pages for block in blocks(page, "python") if not block.startswith("--8<--")]
    assert len(found) > 5
    names: dict[str, Any] = {}
    for block in found:
        exec(block, names)


def test_every_folder_of_the_package_is_explained():
    page = (ROOT / "docs" / "structure.md").read_text("utf-8")
    for file in ROOT.glob("src/pixel2catch/*/__init__.py"):
        assert f"`{file.parent.name}/`" in page


@cache
def messages() -> str:
    """All text of the package's code, with a gap where a value is filled in, and the Makefile."""
    found = [(ROOT / "Makefile").read_text("utf-8")]
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = (str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
                found.append("".join(parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_messages_of_the_troubleshooting_page_exist():
    page = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
    rows = re.findall(r"^\| (`[^|]*) \|", page, re.M)
    named = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
    assert len(named) > 10
    unknown = [text for text in named if text not in messages() and text not in ("doctor",)]
    assert not unknown


@pytest.mark.parametrize(
    "name", ["throws", "features", "servo", "laboratory", pytest.param("latency", marks=pytest.mark.slow)]
)
def test_a_figure_is_drawn(name: str, tmp_path: Path):
    runpy.run_path(str(FIGURES.with_suffix(".py")))["write"](tmp_path, [name])
    (drawn,) = tmp_path.iterdir()
    assert drawn.name == f"{name}.svg"
    assert 10_000 < drawn.stat().st_size < LARGEST_FIGURE


def test_figures_are_small_and_shown():
    shown = "".join(page.read_text("utf-8") for page in (ROOT / "docs").glob("*.md"))
    for path in FIGURES.iterdir():
        assert path.stat().st_size < LARGEST_FIGURE
        assert f"figures/{path.name}" in shown


def test_the_notebook_runs(monkeypatch: pytest.MonkeyPatch, opengl: None):
    monkeypatch.setattr(CatchEnvCfg, "trial_steps", 40)
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    cells = json.loads((ROOT / "docs" / "catching.ipynb").read_text("utf-8"))["cells"]
    said = ["".join(output.get("text", ())) for cell in cells for output in cell.get("outputs", ())]
    assert any("S.R." in text for text in said), "the notebook keeps its outputs"
    names: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]).replace("num_throws=30", "num_throws=2"), names)
    names["plt"].close("all")
