"""Sphinx extension that makes the links of Markdown pages work on the site, as they work in the repository.

A link to a file outside of `docs/` offers the file itself, or leads to the page that shows it. A link to a folder leads
to the API of the folder, and is plain text if it has none.
"""

import re
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
REPOSITORY = DOCS.parent
SHOWN = {"CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"}  # as docs/project/NAME.md

_FENCE = re.compile(r"^(```|:::)\S*.*?^\1$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def site_link(image: str, text: str, target: str, page: Path) -> str:
    """Return a link as the site needs it.

    Args:
        image: "!" for a picture, otherwise empty.
        text: What the link shows.
        target: Where it leads, relative to the page.
        page: File of the page.
    """
    unchanged = f"{image}[{text}]({target})"
    path, _, fragment = target.partition("#")
    if image or not path or re.match(r"[a-z]+:", target):
        return unchanged
    file = (page.parent / path).resolve()
    up = "../" * (len(page.relative_to(DOCS).parts) - 1)
    if file.is_dir():
        package = ".".join(file.relative_to(REPOSITORY).parts)
        documented = (file / "__init__.py").is_file() and package.startswith("coachable")
        return f"[{text}]({up}api/{package}.rst)" if documented else text
    if file.is_relative_to(DOCS) and file.suffix == ".md":
        return unchanged
    if file.parent == REPOSITORY and file.name in SHOWN:
        return f"[{text}]({up}project/{file.stem.lower()}.md{'#' + fragment if fragment else ''})"
    return f"[{text}](<path:{path}>)"


def rewrite(app: Sphinx, docname: str, content: list[str]) -> None:
    """Rewrite the links of a Markdown page; results that the command line wrote get no place in the contents."""
    page = Path(app.env.doc2path(docname))
    if page.suffix != ".md":
        return
    text, parts, end = content[0], [], 0
    for fence in _FENCE.finditer(text):
        parts += [(text[end : fence.start()], True), (fence[0], False)]
        end = fence.end()
    parts.append((text[end:], True))
    content[0] = "".join(
        _LINK.sub(lambda link: site_link(link[1], link[2], link[3], page), part) if prose else part
        for part, prose in parts
    )
    if docname.startswith("results/"):
        content[0] = f"---\norphan: true\n---\n\n{content[0]}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("source-read", rewrite)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
