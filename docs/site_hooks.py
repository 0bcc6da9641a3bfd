"""Hooks of MkDocs: pages from the package and the notebook, and what pages name outside docs/."""

import ast
import base64
import json
import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SOURCE = ROOT / "src" / "pixel2catch"
NOTEBOOK = DOCS / "catching.ipynb"
REFERENCE = "Reference"  #: Entry of the navigation that gets a page for each part of the package.
OVERVIEW = """# API reference

Made from the docstrings of the package. Units are in brackets, shapes in the annotations. What most programs
need is on the page of `api` and in [Extending](../extending/index.md).

| part of `pixel2catch` | what it is for |
| --- | --- |
"""
OUTSIDE = "repository"  #: Folder of the site for files that lie outside docs/.
LINK = re.compile(r"\[([^\[\]]*)\]\(([^)#:\s]+)(#[^)]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of the reference into the navigation, and a menu of versions if mike builds the site."""
    if "MIKE_DOCS_VERSION" in os.environ:
        config.extra["version"] = {"provider": "mike"}
    for entry in config.nav or []:
        if REFERENCE in entry:
            entry[REFERENCE] += [{name: f"reference/{name}.md"} for name in parts()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is no file of docs/."""
    overview = OVERVIEW
    for name, summary in parts().items():
        content = f"# `pixel2catch.{name}`\n\n::: pixel2catch.{name}\n"
        files.append(File.generated(config, f"reference/{name}.md", content=content))
        overview += f"| [`{name}`]({name}.md) | {summary} |\n"
    files.append(File.generated(config, "reference/index.md", content=overview))
    add_notebook(files, config)
    pages = [Path(file.abs_src_path) for file in files if file.src_uri.endswith(".md") and file.abs_src_path]
    for path in linked_outside(pages):
        uri = f"{OUTSIDE}/{path.relative_to(ROOT)}"
        kind = InclusionLevel.NOT_IN_NAV
        files.append(File.generated(config, uri, abs_src_path=str(path), inclusion=kind))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links to files outside docs/ lead to their copies; folders are named without a link.

    Search finds pages for readers before the reference and those copies.
    """
    if page.file.src_uri.startswith(("reference/", f"{OUTSIDE}/")):
        page.meta["search"] = {"boost": 0.001}
    if not page.file.abs_src_path:
        return markdown
    folder = Path(page.file.abs_src_path).parent

    def mended(link: re.Match[str]) -> str:
        text, target, anchor = link.groups()
        path = (folder / re.sub("ipynb$", "md", target)).resolve()
        if path.is_dir():
            return text
        uri = os.path.relpath(path, DOCS) if DOCS in path.parents else f"{OUTSIDE}/{path.relative_to(ROOT)}"
        return f"[{text}]({os.path.relpath(uri, os.path.dirname(page.file.src_uri))}{anchor or ''})"

    return LINK.sub(mended, markdown)


def parts() -> dict[str, str]:
    """First paragraph of the docstring of every folder and module of the package, by name."""
    found = {path.parent.name: path for path in sorted(SOURCE.glob("*/__init__.py"))}
    found |= {path.stem: path for path in sorted(SOURCE.glob("*.py")) if not path.stem.startswith("_")}
    docstrings = {name: ast.get_docstring(ast.parse(path.read_text("utf-8"))) for name, path in found.items()}
    return {name: (text or "").split("\n\n")[0].replace("\n", " ") for name, text in docstrings.items()}


def linked_outside(pages: list[Path]) -> list[Path]:
    """Files outside docs/ that pages link to, and those that the pages among them link to."""
    found: list[Path] = []
    for page in (queue := list(pages)):
        for _, target, _ in LINK.findall(page.read_text("utf-8")):
            path = (page.parent / target).resolve()
            if path.is_file() and DOCS not in path.parents and path not in found:
                found.append(path)
                queue += [path] if path.suffix == ".md" else []
    return found


def add_notebook(files: Files, config: MkDocsConfig) -> None:
    """The notebook as a page: its text, its code, and its outputs as they are kept in it."""
    content = ""
    for number, cell in enumerate(json.loads(NOTEBOOK.read_text("utf-8"))["cells"]):
        source = "".join(cell["source"])
        content += f"{source}\n\n" if cell["cell_type"] == "markdown" else f"```python\n{source}\n```\n\n"
        for place, output in enumerate(cell.get("outputs", ())):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"catching-{number}-{place}.png"
                image = base64.b64decode("".join(data["image/png"]))
                files.append(File.generated(config, name, content=image))
                content += f"![Output of the cell above]({name})\n\n"
            else:
                text = "".join(output.get("text", data.get("text/plain", ())))
                content += f"```text\n{text}\n```\n\n"
    files.append(File.generated(config, "catching.md", content=content))
