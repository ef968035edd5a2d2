"""The documentation begins with an agent that acts in the reader's browser, or with a picture where no page can be."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = """# Title

:::{acting-page} humanoid
:title: A walker & you

![The walker](walker.png)
:::
"""


CONFIGURATION = """
import sys
from pathlib import Path
sys.path.insert(0, {extensions!r})
import acting_page

extensions = ["myst_nb", "acting_page"]
myst_enable_extensions = ["colon_fence"]

def export_page(agent, domain, out, *, home):
    out.mkdir(parents=True)
    (out / "index.html").write_text(f'<a href="{{home}}">home</a>')
    if {missing!r}:
        raise FileNotFoundError({missing!r})
    return 12

acting_page.export_page = export_page
"""


@pytest.fixture
def build(tmp_path):
    """Build a site that shows the page of an agent, or cannot write it for a reason, and return what was printed."""
    pytest.importorskip("myst_nb")

    def run(missing=""):
        source = tmp_path / "source"
        (source / "deep").mkdir(parents=True)
        (source / "deep" / "first.md").write_text(PAGE)
        (source / "deep" / "walker.png").write_bytes(b"")
        (source / "index.md").write_text("# Index\n\n```{toctree}\ndeep/first\n```\n")
        extensions = str(ROOT / "docs" / "_extensions")
        (source / "conf.py").write_text(CONFIGURATION.format(extensions=extensions, missing=missing))
        command = [sys.executable, "-m", "sphinx", "-W", "-q", source, tmp_path / "site"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return tmp_path / "site", done.stderr

    return run


def test_the_site_contains_the_page_in_a_frame_with_a_title(build):
    site, _ = build()
    html = (site / "deep" / "first.html").read_text()
    assert '<iframe src="../humanoid/index.html" title="A walker &amp; you"' in html
    assert '<a href="../humanoid/index.html">Open it as a page of its own</a>' in html
    assert re.search(r"<noscript>\s*(<p>)?<img", html)
    assert (site / "humanoid" / "index.html").read_text() == '<a href="../deep/first.html">home</a>'


def test_a_picture_stands_where_no_page_can_be(build):
    site, printed = build(missing="the page needs npm")
    html = (site / "deep" / "first.html").read_text()
    assert "<iframe" not in html and "<noscript" not in html and "walker.png" in html
    assert not (site / "humanoid").exists()
    assert "a picture instead of the page of humanoid: the page needs npm" in printed


def test_the_documentation_begins_with_the_walker():
    text = (ROOT / "docs" / "index.md").read_text()
    before, _, _ = text.partition(":::{acting-page} humanoid\n:title: ")
    assert len(before) < 300 and "![" not in before
