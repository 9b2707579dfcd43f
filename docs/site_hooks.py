"""Hooks of MkDocs: the navigation from the index, and links to what lies outside this folder.

The index, `README.md` beside this file, names every page under a heading; the
site shows the same sections. Pages link to files of the repository outside
`docs` (examples, deploy, the changelog), as GitHub shows them; the site gets a
copy of each, under `repository/`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

DOCS = Path(__file__).parent
PROJECT = DOCS.parent
LINK = re.compile(r"(?<=\]\()([^)\s#]+)(?=[)#])")
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.MULTILINE | re.DOTALL)
ELSEWHERE = re.compile(r"[a-z]+:|#")


def on_config(config: Any) -> Any:
    """The sections of the index, each with the pages that it links to."""
    text = (DOCS / "README.md").read_text("utf-8")
    _, *parts = re.split(r"^## (.*)$", text, flags=re.MULTILINE)
    sections = dict(zip(parts[::2], map(pages_of, parts[1::2]), strict=True))
    config["nav"] = [{"Home": "README.md"}, *({name: pages} for name, pages in sections.items() if pages)]
    return config


def pages_of(section: str) -> list[Any]:
    """The pages a section links to; of a folder's own index, the folder's other pages too."""
    pages: list[Any] = []
    for title, link in re.findall(r"\[([^\]]*)\]\(([^)#]+)\)", section):
        folder, _, name = link.rpartition("/")
        if name == "README.md":
            others = sorted(p.relative_to(DOCS).as_posix() for p in (DOCS / folder).glob("*.md") if p.name != name)
            pages.append({title: [link, *others]})
        else:
            pages.append({title: link} if link.endswith(".ipynb") else link)
    return pages


def links_outside(text: str, folder: Path) -> Iterator[tuple[str, Path]]:
    """The links of a page in ``folder`` that lead to files outside `docs`, and these files."""
    for target in LINK.findall(CODE.sub("", text)):
        path = (folder / target).resolve()
        if not ELSEWHERE.match(target) and path.is_file() and not path.is_relative_to(DOCS):
            yield target, path


def uri_of(path: Path) -> str:
    """The place of a file in the site, as MkDocs names sources."""
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    return f"repository/{path.relative_to(PROJECT).as_posix()}"


def on_files(files: Files, config: Any) -> Files:
    """Adds the files outside `docs` that pages link to, and those that these link to."""
    todo = [Path(f.abs_src_path) for f in files.documentation_pages() if f.src_uri.endswith(".md")]
    while todo:
        page = todo.pop()
        for _, path in links_outside(page.read_text("utf-8"), page.parent):
            if files.get_file_from_path(uri_of(path)) is None:
                outside = InclusionLevel.NOT_IN_NAV
                files.append(File.generated(config, uri_of(path), abs_src_path=str(path), inclusion=outside))
                if path.suffix == ".md":
                    todo.append(path)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links by the places in the site, where these are not those in the repository."""
    source = Path(page.file.abs_src_path)
    if source.suffix != ".md":
        return markdown
    moved = not source.is_relative_to(DOCS)

    def relinked(link: re.Match[str]) -> str:
        path = (source.parent / link[1]).resolve()
        if ELSEWHERE.match(link[1]) or not path.is_relative_to(PROJECT) or not (moved or not path.is_relative_to(DOCS)):
            return link[1]
        return os.path.relpath(uri_of(path), Path(page.file.src_uri).parent)

    return LINK.sub(relinked, markdown)
