"""Sphinx extension that shows an agent which acts in the visitor's browser.

The directive `acting-page` takes the name of an agent, a title as its option, and a picture as its content:

    :::{acting-page} humanoid
    :title: A walker that you coach

    ![The walker](walker.png)
    :::

The page of `coachable export web AGENT` is written into the built site, at `AGENT/index.html`, and shown within a
frame. The picture stands in its place where no page can be: in other formats than HTML, in browsers without JavaScript,
and everywhere if the build cannot get the files of other projects that the page needs. The build says so.
"""

import shutil
import sys
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective
from sphinx.util.osutil import relative_uri

from coachable.export.web.simulated_page import export_page
from coachable.training.weights import domain_of, load_policy

LOGGER = logging.getLogger(__name__)


class Frame(nodes.General, nodes.Element):
    """The frame, with the picture as its children."""


class ActingPage(SphinxDirective):
    """Frame with the page of an agent."""

    required_arguments = 1
    has_content = True
    option_spec: ClassVar = {"title": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """Return the frame."""
        frame = Frame(agent=self.arguments[0], title=self.options["title"])
        self.state.nested_parse(self.content, self.content_offset, frame)
        agents = self.env.metadata[self.env.docname].setdefault("acting pages", [])
        agents.append((frame["agent"], self.env.docname))
        return [frame]


def write_pages(app: Sphinx, env: Any) -> None:
    """Write the page of each agent, with a link to the first document that shows it."""
    if app.builder.format != "html":
        return
    for agents in [data.get("acting pages", []) for data in env.metadata.values()]:
        for name, document in agents:
            folder, agent = Path(app.outdir) / name, load_policy(name)
            uri = relative_uri(f"{name}/index.html", app.builder.get_target_uri(document))
            try:
                size = export_page(agent, domain_of(agent), folder, home=uri)
            except OSError as error:  # npm is missing, or has no connection
                shutil.rmtree(folder, ignore_errors=True)
                sys.stderr.write(f"The site shows a picture instead of the page of {name}: {error}\n")
            else:
                LOGGER.info("wrote the page of %s (%.1f MB)", name, size / 1e6)


def is_written(translator: Any, node: Frame) -> bool:
    """Return whether the site contains the page of a frame."""
    return (Path(translator.builder.outdir) / node["agent"] / "index.html").is_file()


def enter_frame(translator: Any, node: Frame) -> None:
    """Write the frame and a link to the page; the children follow for browsers without JavaScript."""
    if not is_written(translator, node):
        return
    builder = translator.builder
    address = relative_uri(builder.get_target_uri(builder.current_docname), f"{node['agent']}/index.html")
    title = translator.attval(node["title"])
    translator.body.append(
        f'<figure class="acting-page"><iframe src="{address}" title="{title}" allow="clipboard-write"></iframe>'
        f'<figcaption><a href="{address}">Open it as a page of its own</a></figcaption></figure>\n<noscript>'
    )


def leave_frame(translator: Any, node: Frame) -> None:
    """End what browsers without JavaScript show."""
    if is_written(translator, node):
        translator.body.append("</noscript>\n")


def ignore(_translator: Any, _node: Frame) -> None:
    """Write the children alone."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.add_node(Frame, html=(enter_frame, leave_frame), text=(ignore, ignore), latex=(ignore, ignore))
    app.add_directive("acting-page", ActingPage)
    app.connect("env-updated", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
