"""How the package is installed: missing extras, hashes, versions, the container and hosted CI."""

import fnmatch
import json
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from packaging.utils import canonicalize_name

from pixel2catch.installation import install_command, requirements

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
PYTHONS = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)]
TARGETS = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)

PINNED = ("requirements.txt", "requirements-dev.txt")


def test_everything_that_make_setup_installs_has_its_hash():
    """Each pin has hashes, and each package of the extras is pinned."""
    pins = set[str]()
    for name in PINNED:
        text = (ROOT / name).read_text("utf-8").replace("\\\n", "")
        for line in text.splitlines():
            if not line.startswith("#"):
                pin, *hashes = line.split()
                assert hashes, pin
                assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", each) for each in hashes), pin
                pins.add(canonicalize_name(pin.partition("==")[0]))
    for extra in ("", "deployment", "perception", "sam2", "docs"):
        assert {canonicalize_name(name) for name in requirements(extra)} <= pins


@pytest.mark.parametrize(
    ("origin", "what"),
    [
        (None, "'pixel2catch[sam2]'"),
        ({"url": "file:///a%20b", "dir_info": {"editable": True}}, "-e '/a b[sam2]'"),
        ({"url": "file:///x.whl", "archive_info": {}}, "'pixel2catch[sam2] @ file:///x.whl'"),
        ({"url": "https://x/y", "vcs_info": {"vcs": "git"}}, "'pixel2catch[sam2] @ git+https://x/y'"),
    ],
)
def test_extras_come_from_where_the_package_came_from(origin, what, monkeypatch):
    found = SimpleNamespace(read_text=lambda _: json.dumps(origin) if origin else None)
    monkeypatch.setattr("importlib.metadata.distribution", lambda _: found)
    assert install_command("sam2").endswith(f"install {what}")


def test_there_is_one_version():
    """CITATION.cff, the ROS package and the changelog have the version of pyproject.toml."""
    found = {
        "CITATION.cff": r"^version: (\S+)$",
        "ros/pixel2catch_ros/package.xml": r"<version>(.+)</version>",
        "CHANGELOG.md": r"^## (\d\S+)$",
    }
    for file, pattern in found.items():
        match = re.search(pattern, (ROOT / file).read_text("utf-8"), re.MULTILINE)
        assert match, file
        assert match[1] == PROJECT["version"], file


def test_the_container_is_built_of_what_is_here():
    text = (ROOT / "Containerfile").read_text("utf-8").replace("\\\n", "")
    lines = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
    (image, _, base), (last,) = (words for kind, *words in lines if kind == "FROM")
    assert last == base
    assert re.fullmatch(r"python:(\S+)-slim-\w+", image)[1] in PYTHONS  # pyright: ignore[reportOptionalSubscript]
    needed = [name for kind, *words in lines if kind == "COPY" for name in words[:-1]]
    patterns = [p[1:] for p in (ROOT / ".dockerignore").read_text("utf-8").split() if p.startswith("!")]
    for name in needed:
        assert (ROOT / name).exists(), name
        assert any(fnmatch.fnmatch(name, pattern) for pattern in patterns), name
    assert {*PINNED, "pyproject.toml", PROJECT["readme"], *PROJECT["license-files"]} <= {*needed}
    (made,) = (words[1] for kind, *words in lines if kind == "RUN" and words[0] == "make")
    assert made in TARGETS
    (entry,) = (json.loads(words[0])[0] for kind, *words in lines if kind == "ENTRYPOINT")
    assert entry in PROJECT["scripts"]
    folder = ROOT / ".devcontainer"
    dev = json.loads((folder / "devcontainer.json").read_text("utf-8"))
    assert (folder / dev["build"]["dockerfile"]).resolve() == ROOT / "Containerfile"
    assert dev["build"]["target"] == base
    assert dev["postCreateCommand"].split() == ["make", made]


def test_hosted_ci_runs_every_python_that_is_named():
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8"))["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == PYTHONS
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"
    assert (ROOT / job["steps"][-1]["run"]).stat().st_mode & 0o100
