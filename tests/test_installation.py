"""The command that installs what is missing is right before and after publication."""

import re
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from pixel2catch.installation import install_command, requirement, requirements

ROOT = Path(__file__).parents[1]

INDEX: dict = {}
CHECKOUT = {"url": "file:///home/me/pixel%20catch", "dir_info": {"editable": True}}
FOLDER = {"url": "file:///src/pixel2catch", "dir_info": {}}
WHEEL = {"url": "file:///tmp/pixel2catch-1-py3-none-any.whl", "archive_info": {}}
REPOSITORY = {"url": "https://example.org/p.git", "vcs_info": {"vcs": "git", "commit_id": "0" * 40}}


@pytest.mark.parametrize(
    ("origin", "extra", "expected"),
    [
        (INDEX, "", "pixel2catch"),
        (INDEX, "twin", "'pixel2catch[twin]'"),
        (CHECKOUT, "twin", "-e '/home/me/pixel catch[twin]'"),
        (FOLDER, "", "'pixel2catch @ file:///src/pixel2catch'"),
        (WHEEL, "sam2", "'pixel2catch[sam2] @ file:///tmp/pixel2catch-1-py3-none-any.whl'"),
        (REPOSITORY, "twin", "'pixel2catch[twin] @ git+https://example.org/p.git'"),
    ],
)
def test_what_to_install(origin: dict, extra: str, expected: str):
    assert requirement(origin, extra) == expected


def test_this_installation_knows_where_it_came_from():
    assert install_command("twin").startswith("pip install -e ")
    assert install_command("twin").removesuffix("'").endswith("[twin]")


def test_everything_that_make_setup_installs_has_its_hash():
    """Each pin has hashes, and each package of the extras is pinned."""
    pins = set[str]()
    for name in ("requirements.txt", "requirements-dev.txt"):
        text = (ROOT / name).read_text("utf-8").replace("\\\n", "")
        for line in text.splitlines():
            if not line.startswith("#"):
                pin, *hashes = line.split()
                assert hashes, pin
                assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", each) for each in hashes), pin
                pins.add(canonicalize_name(pin.partition("==")[0]))
    for extra in ("", "deployment", "perception", "sam2", "docs"):
        assert {canonicalize_name(name) for name in requirements(extra)} <= pins
