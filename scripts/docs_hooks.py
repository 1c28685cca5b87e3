"""mkdocs' hooks: the pages' version, and their links to files of the checkout, which are not in the site."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\n)+)\]\(([^)\s#:]+)(?:#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Show below each page for which version it is."""
    project = (Path(config["docs_dir"]).parent / "contract" / "pyproject.toml").read_text()
    config["copyright"] = "iort " + re.findall(r'(?m)^version = "(.+)"$', project)[0]
    return config


def on_page_markdown(markdown: str, page: Any, config: Any, **_: object) -> str:
    """Leave the text of each link to a file outside docs/, and the file's path behind it."""
    folder, docs = Path(page.file.abs_src_path).parent, Path(config["docs_dir"])

    def outside(link: re.Match[str]) -> str:
        target = (folder / link[2]).resolve()
        if target.is_relative_to(docs) and not target.is_relative_to(docs / "examples"):
            return link[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_uri}: no file {link[2]}")
        path = f"`{target.relative_to(docs.parent)}`"
        return path if link[1].strip("`") in path else f"{link[1]} ({path})"

    return _LINK.sub(outside, markdown)
