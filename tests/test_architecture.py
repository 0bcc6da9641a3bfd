"""The rules of the house that a program can check."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import torch
from jaxtyping import TypeCheckError

from pixel2catch.mdp.observations import pixel_features
from pixel2catch.scene.constants import RGB_CAMERA

ROOT = Path(__file__).parents[1]
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def python_files(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT))


def configurations(tree: ast.Module) -> Iterator[ast.ClassDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name.endswith("Cfg"):
            yield node


def field_names(configuration: ast.ClassDef) -> list[str]:
    declared = (node for node in configuration.body if isinstance(node, ast.AnnAssign))
    return [
        node.target.id
        for node in declared
        if isinstance(node.target, ast.Name) and "ClassVar" not in ast.unparse(node.annotation)
    ]


def decorator_keywords(node: ast.ClassDef) -> set[str]:
    calls = (decorator for decorator in node.decorator_list if isinstance(decorator, ast.Call))
    return {ast.unparse(keyword) for call in calls for keyword in call.keywords}


def names_read(tree: ast.AST) -> set[str]:
    """Attributes that the code reads; a configuration that only validates a value does not use it."""
    if isinstance(tree, ast.FunctionDef) and tree.name == "__post_init__":
        return set()
    own = {tree.attr} if isinstance(tree, ast.Attribute) and isinstance(tree.ctx, ast.Load) else set()
    return own.union(*(names_read(child) for child in ast.iter_child_nodes(tree)))


@cache
def all_names_read() -> frozenset[str]:
    return frozenset().union(*(names_read(parse(path)) for path in python_files("src")))


def test_every_configuration_field_is_read():
    unread = [
        f"{ids(path)}: {configuration.name}.{name}"
        for path in python_files("src")
        for configuration in configurations(parse(path))
        for name in field_names(configuration)
        if name not in all_names_read()
    ]
    assert not unread, "nothing reads these fields: use them or delete them"


def test_configurations_are_frozen_and_keyword_only():
    loose = [
        f"{ids(path)}: {configuration.name}"
        for path in python_files("src")
        for configuration in configurations(parse(path))
        if not {"frozen=True", "kw_only=True"} <= decorator_keywords(configuration)
    ]
    assert not loose, "decorate these with @dataclass(frozen=True, kw_only=True)"


def test_files_and_functions_are_short():
    paths = python_files("src", "tests", "benchmarks", "examples", "docs")
    long = [ids(path) for path in paths if len(path.read_text("utf-8").splitlines()) >= MAX_FILE_LINES]
    long += [
        f"{ids(path)}: {node.name}"
        for path in paths
        for node in ast.walk(parse(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno + 1 >= MAX_FUNCTION_LINES
    ]
    assert not long


def test_shapes_are_checked_while_testing():
    with pytest.raises(TypeCheckError):
        pixel_features(torch.zeros(2, 4), torch.zeros(2, 3), RGB_CAMERA)
