"""Looks of the page: title, icon, dark mode and the place of the gauges, which viser has no settings for."""

import gzip
import re
from functools import lru_cache
from pathlib import Path

from websockets.http11 import Response

from coachable.scene.look import FONT, TITLE, icon_link, stylesheet
from coachable.scene.palette import INK, WHITE, css

DAY, NIGHT = "light", "dark"  # the buttons that change the scene in one browser

# viser shows the page in dark colours if the address says so. The browser's own setting decides here. A dark browser
# presses the button for a dark scene as soon as there is one; what has no scene, such as pictures, is dimmed.
_SCRIPT = """
(() => {
  const asked = new URLSearchParams(location.search);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  if (dark.matches && !asked.has("darkMode") && !asked.has("lightMode")) {
    asked.set("darkMode", "");
    history.replaceState(null, "", "?" + asked);
  }
  const page = document.documentElement.classList;
  page.toggle("dark", asked.has("darkMode"));
  const press = page.contains("dark") && setInterval(() => {
    const buttons = [...document.querySelectorAll("button")];
    const text = (button) => button?.textContent.trim();
    const night = buttons.find((button, i) => text(button) === "NIGHT" && text(buttons[i - 1]) === "DAY");
    if (!night) return;
    night.click();
    page.add("lit");
    clearInterval(press);
  }, 500);
})();
""".replace("NIGHT", NIGHT).replace("DAY", DAY)

_STYLE = (
    """
:root { --mantine-font-family: FONT !important; --mantine-font-family-headings: FONT !important; }
body { font-family: FONT !important; }
.dark:not(.lit) canvas:not(.u-wrap *) { filter: brightness(0.6) contrast(1.1); }
.gauges {
  position: fixed; left: 12px; bottom: 12px; z-index: 5; pointer-events: none; min-width: 15em; padding: 6px 10px;
  border-radius: 8px; background: INKc7; color: WHITE; font: 13px/1.6 FONT;
}
.gauges:empty { display: none; }
.gauge { display: flex; gap: 8px; align-items: center; }
.gauge b { flex: 0 0 10.2em; font-weight: 400; opacity: 0.85; white-space: nowrap; }
.gauge span { position: relative; flex: 1; min-width: 9em; height: 1.45em; border-radius: 3px; overflow: hidden; }
.gauge span:has(i) { background: rgba(255, 255, 255, 0.16); }
.gauge i { position: absolute; inset: 0 auto 0 0; }
.gauge em { position: relative; font-style: normal; padding: 0 6px; text-shadow: 0 0 3px #000, 0 0 2px #000; }
.map {
  position: fixed; left: 12px; top: 12px; z-index: 5; width: 150px; height: 150px; pointer-events: none;
  border-radius: 8px; background: INK8c;
}
.legend { margin: 0 1em 0.6em; font-size: 0.85em; }
.legend summary { cursor: pointer; opacity: 0.8; }
.links { margin: 4px 12px; font-size: 13px; }
.links a { color: #0a7aba; }
.legend div { display: flex; gap: 8px; align-items: center; }
.legend i { flex: none; width: 14px; height: 14px; border-radius: 3px; border: 1px solid rgba(128, 128, 128, 0.7); }
@media (max-width: 720px) {
  .gauges { left: 6px; font-size: 10px; line-height: 1.35; min-width: 0; padding: 3px 6px;
    box-sizing: border-box; max-width: calc(100vw - 400px); overflow: hidden; }
  .gauge b { flex: 0 1 10em; overflow: hidden; text-overflow: ellipsis; }
  .gauge span { min-width: 7em; }
}
@media (max-width: 576px) {
  .gauges { top: 6px; bottom: auto; max-width: none; background: INK8c; }
  .gauge:nth-child(n + 5) { display: none; }
  [style*="width: 20em"] { width: 100% !important; }
  .map { left: auto; right: 6px; top: 6px; width: 90px; height: 90px; }
}
""".replace("INK", css(INK))
    .replace("WHITE", css(WHITE))
    .replace("FONT", FONT)
)


def pad_page() -> str:
    """Return the page for keys and gamepads, as HTML."""
    page = Path(__file__).with_name("pad.html").read_text(encoding="utf-8")
    return page.replace("ICON", icon_link(), 1).replace("LOOK", stylesheet(), 1)


def dressed(response: Response) -> Response:
    """Give a response of viser the page's own title, icon and styles; responses that are not pages are left alone."""
    if "text/html" in response.headers.get("Content-Type", ""):
        response.body = _dressed(bytes(response.body or b""), response.headers.get("Content-Encoding") == "gzip")
        if "Content-Length" in response.headers:
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
    return response


@lru_cache(maxsize=4)
def _dressed(body: bytes, packed: bool) -> bytes:
    text = gzip.decompress(body) if packed else body
    title = f"<title>{TITLE}</title><style>{_STYLE}</style><script>{_SCRIPT}</script>".encode()
    text = text.replace(b"<title>Viser</title>", title, 1)
    icon = f'href="{icon_link()}"'.encode()
    text = re.sub(rb'href="data:image/svg\+xml,[^"]*"', lambda _: icon, text, count=1)
    text = text.replace(b"Viser client", b"Coach an agent while it acts", 1)
    return gzip.compress(text) if packed else text
