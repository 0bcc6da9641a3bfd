"""The command that installs what is missing is right before and after publication."""

import pytest

from pixel2catch.installation import install_command, requirement

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
