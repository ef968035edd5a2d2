"""The folder of the page: what is in it, where files of other projects come from, and the page's arithmetic."""

import base64
import gzip
import json
import math
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest
import torch

from coachable.cli import main
from coachable.domain import load_domain
from coachable.domains.humanoid.metrics import FORWARD_SPEED
from coachable.domains.humanoid.stage import HumanoidStage
from coachable.domains.racing.car_view import GAUGES, VALUES
from coachable.export.web import pinned_files
from coachable.export.web.simulated_page import home_page
from coachable.scene.frame import Frame, Gauge
from coachable.scene.palette import css
from coachable.scene.parts import Parts
from coachable.scene.recorded import encode_frames

STATIC = Path(str(files("coachable.export.web"))) / "static"


def test_the_page_is_small_and_names_no_folder_of_this_machine(site):
    written = [file for file in site.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in written) < 25e6
    for file in written:
        if "third_party" not in file.parts:
            content = file.read_bytes()
            assert str(Path.home()).encode() not in content and str(STATIC).encode() not in content, file
    manifest = json.loads((site / "manifest.json").read_text())
    for download in manifest["downloads"]:
        assert (site / download["file"]).stat().st_size == download["bytes"]


def test_the_page_names_early_what_its_scripts_ask_for(site, recorded_site):
    for folder, first, other in ((site, "simulated.js", "recorded.js"), (recorded_site, "recorded.js", "simulated.js")):
        page = (folder / "index.html").read_text()
        named = re.findall(r'<link rel="(?:module)?preload" href="([^"]+)"', page)
        assert all((folder / name).is_file() for name in named) and len(named) == len(set(named))
        assert {first, "dom.js", "page.js", "view.js", "third_party/three/build/three.module.min.js"} <= set(named)
        assert other not in named and "<!-- preloads -->" not in page
    assert {"policy.onnx", "features.onnx", "third_party/@mujoco/mujoco/mujoco.wasm"} <= set(
        re.findall(r'<link rel="preload" href="([^"]+)" as="fetch"', (site / "index.html").read_text())
    )


def test_the_page_links_to_a_documentation_that_is_known(site, recorded_site):
    assert json.loads((site / "manifest.json").read_text())["home"] == "../index.html"
    assert json.loads((recorded_site / "manifest.json").read_text())["home"] == home_page()


def test_a_walker_with_a_styled_speed_measures_it():
    domain = load_domain("humanoid_gait")
    assert domain.make_web is not None
    part = domain.make_web(domain.make_space())
    observation, measured, mark, memory, terminated = part.features(*part.example.values())
    assert [measure.parameter for measure in part.measures] == ["pose", "step_length", "speed", "course"]
    shapes = [tuple(result.shape) for result in (observation, measured, mark, memory, terminated)]
    assert shapes == [(1, 82), (1, 4), (1, 5), tuple(part.example["memory"].shape), (1,)]


def test_a_heading_is_the_direction_of_travel():
    domain = load_domain("humanoid")
    assert domain.make_web is not None
    part = domain.make_web(domain.make_space())
    start = {name: torch.tensor([part.starts[0][name]], dtype=torch.float64) for name in ("positions", "memory")}
    velocities = torch.zeros_like(part.example["velocities"])
    sensors = torch.zeros_like(part.example["sensors"])
    headings = []
    for course in (0.0, 30.0):
        controls = torch.tensor([[course]], dtype=torch.float64)
        arguments = (start["positions"], velocities, sensors, controls, part.example["style"], start["memory"])
        observation, measured, *_ = part.features(*arguments)
        forward, left = observation[0, FORWARD_SPEED : FORWARD_SPEED + 2].tolist()
        headings.append((measured[0, -1].item(), course + math.degrees(math.atan2(left, forward))))
    for heading, expected in headings:
        assert heading == pytest.approx(expected, abs=1e-3)


def test_the_page_has_the_looks_of_the_stage():
    domain = load_domain("humanoid")
    assert domain.make_web is not None
    part = domain.make_web(domain.make_space())
    assert [meaning for _, meaning in part.scene.legend] == [meaning for _, meaning in HumanoidStage.legend]
    assert part.scene.bodies["right_foot"] != part.scene.bodies["left_foot"]
    assert part.opens == {"pose": "t_pose", "step_length": 0.5}


@pytest.mark.parametrize("option", ["--assets", "--track"])
def test_options_of_pages_belong_to_pages(option, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "onnx", "racing_drift", option, str(tmp_path)]) == 2
    assert f"{option} is for pages: expected coachable export web racing_drift" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_page_names_options_that_its_domain_lacks(capsys, tmp_path):
    assert main(["export", "web", "humanoid", "--out", str(tmp_path / "site"), "--track=own.csv"]) == 2
    assert "humanoid has no option --track: expected no options of its own" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_changed_files_of_other_projects_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"mujoco\.js is missing or is not the file of @mujoco/mujoco 3\.14\.0"):
        pinned_files.provide(tmp_path)
    file = tmp_path / "@mujoco/mujoco/mujoco.js"
    file.parent.mkdir(parents=True)
    file.write_text("something else")
    with pytest.raises(ValueError, match="is not the file of"):
        pinned_files.provide(tmp_path)


def test_without_npm_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(FileNotFoundError, match=r"install Node\.js 20, or name a folder with the files by --assets"):
        pinned_files.provide()


def test_an_archive_with_another_hash_is_refused():
    with pytest.raises(OSError, match="has another hash"):
        list(pinned_files._unpack(pinned_files.packages()[0], b"something else"))


SCRIPT = """
import assert from "node:assert/strict";
const { approach, entriesOf, defaultsOf, thetaOf, controlsOf, ...links } = await import(REQUEST);
const { fixed, fragmentOf, fromFragment, isOutside } = links;
const shown = [[-0.004, 2], [-0.4, 0], [0, 2], [-0.006, 2], ["1.25", 1]].map((given) => fixed(...given));
assert.deepEqual(shown, ["0.00", "0", "0.00", "-0.01", "1.3"]);
const { Readout } = await import(READOUT);
const manifest = {
  style_space: { parameters: [
    { kind: "choice", name: "pose", options: ["up", "down"], default: "up" },
    { kind: "setpoint", name: "step_length", low: 0.3, high: 0.65, unit: "m", default: 0.475 },
  ] },
  controls: [{ name: "course", low: -180, high: 180, unit: "deg", default: 0 }],
};
const entries = entriesOf(manifest);
const request = { ...defaultsOf(entries), pose: "down", step_length: 0.5 };
assert.deepEqual(thetaOf(entries, request), [0, 1, 0.5]);
assert.deepEqual(controlsOf(entries, request), [0]);
assert.equal(fragmentOf(entries, request), "#pose=down&step_length=0.50&course=0");
assert.deepEqual(fromFragment(entries, fragmentOf(entries, request), defaultsOf(entries)), request);
const foreign = fromFragment(entries, "#pose=<b>&step_length=1e9&course=NaN&x=1", request);
assert.deepEqual(foreign, { pose: "down", step_length: entries[1].to, course: 0 });
const between = fromFragment(entries, "#step_length=0.476&course=35.2", request); // the slider has steps of 0.01 and 10
assert.deepEqual([between.step_length, between.course], [0.48, 40]);
assert.equal(fragmentOf(entries, between), "#pose=down&step_length=0.48&course=40");
assert.ok(isOutside(entries[1], 0.66) && !isOutside(entries[1], 0.65) && !isOutside(entries[2], 180));
const readout = new Readout([{ name: "held" }, { name: "length", at_marks: true }], 3);
assert.equal(readout.mean("held"), null);
[[0, 0, NaN], [2, 1, 0.4], [4, 1, 0.6]].forEach(([time, ...values]) => readout.add(time, values));
assert.equal(readout.mean("held"), 1); // the first row has left the window
assert.equal(readout.mean("length"), 0.5);
assert.deepEqual(readout.last("length"), [0.4, 0.6]);
const course = { low: -180, high: 180, circular: true, rate: 40 };
assert.equal(approach(course, 0, 90, 0.5), 20);
assert.equal(approach(course, 80, 90, 0.5), 90);
assert.equal(approach(course, 170, -150, 0.5), -170); // the shorter way
assert.equal(approach(course, -170, 150, 0.25), 180 - 360);
assert.equal(approach({ ...course, rate: null }, 0, 90, 0.01), 90);
const towards = new Readout([{ name: "heading", circular: true }], 3);
[170, -170].forEach((value) => towards.add(0, [value]));
assert.equal(Math.abs(Math.round(towards.mean("heading"))), 180);
readout.clear();
assert.equal(readout.mean("length"), null);
const used = new Readout([{ name: "fuel", per: "way" }, { name: "way" }], 10);
assert.equal(used.mean("fuel"), null);
[[0, 1, 2], [9, 3, 2], [10, 2, 1]].forEach(([time, ...values]) => used.add(time, values));
assert.equal(used.mean("fuel"), 6 / 5); // all of it per all of the way
"""


GAUGE = """
import assert from "node:assert/strict";
globalThis.document = {};
const { gaugeOf } = await import(DIALS);
assert.deepEqual(ROWS.map((values) => FORMS.map((form) => gaugeOf(form, values))), EXPECTED);
"""


RECORDINGS = """
import assert from "node:assert/strict";
const { decode, nearest, along, varied, fromFragment, fragmentOf } = await import(RECORDING);
const styles = [[0, 0], [0, 50], [0, 100], [9, 0], [9, 100]].map(([tire, fuel]) => ({ pace: 1, tire, fuel }));
const manifest = {
  parameters: [
    { name: "pace", kind: "number", values: [1] },
    { name: "tire", kind: "number", values: [0, 9] },
    { name: "fuel", kind: "number", values: [0, 50, 100] },
  ],
  recordings: styles.map((style) => ({ style })),
};
assert.deepEqual(varied(manifest).map(({ name }) => name), ["tire", "fuel"]);
assert.equal(nearest(manifest, { tire: 0, fuel: 60 }), 1);
assert.equal(nearest(manifest, { tire: 9, fuel: 50 }, "tire") >= 3, true); // there is none with both
assert.equal(nearest(manifest, { tire: 9, fuel: 50 }, "fuel"), 1);
assert.deepEqual(along(manifest, styles[4], "fuel"), [[0, 3], [100, 4]]);
assert.deepEqual(along(manifest, styles[4], "tire"), [[0, 2], [9, 4]]);
assert.equal(fragmentOf(manifest, 4), "#tire=9&fuel=100");
assert.deepEqual(fromFragment(manifest, fragmentOf(manifest, 4, 2.5)), { number: 4, moment: 2.5 });
assert.deepEqual(fromFragment(manifest, fragmentOf(manifest, 4, 0)), { number: 4, moment: 0 });
assert.deepEqual(fromFragment(manifest, "#tire=<b>&fuel=1e9&t=-3"), { number: 2, moment: 0 });
assert.deepEqual(fromFragment(manifest, "#tire=NaN&fuel=&t=x"), { number: 0, moment: null });
for (const packed of [true, false]) {
  const recording = await decode(new Uint8Array(Buffer.from(packed ? PACKED : PLAIN, "base64")));
  assert.equal(recording.frames, 2);
  assert.deepEqual([...recording.arrays.get("focus")], [1, 2, 3, 4, 5, 6]);
  assert.deepEqual(recording.gauges[1], [["speed", "3 m/s", 0.25, "#0072b2"]]);
}
"""


def test_recordings_are_decoded_and_found():
    frames = [Frame(Parts(), focus, 0.0, gauges=[Gauge("speed", "3 m/s", 0.25)]) for focus in ((1, 2, 3), (4, 5, 6))]
    packed = encode_frames(frames, {"": 0})
    texts = {"PACKED": packed, "PLAIN": gzip.decompress(packed)}
    script = RECORDINGS
    for name, content in texts.items():
        script = script.replace(name, json.dumps(base64.b64encode(content).decode()))
    run_in_node(script, "recording")


def test_gauges_are_those_of_the_stage():
    rows = [[0.0] * len(VALUES), [151.6, 4.0, 100.0, 0.4, 12.4, 1.0, 33.33, 5.0, 6.4, 70.0, 77.6, 0.776, 1.0]]
    numbers = [dict(zip(VALUES, row, strict=True)) for row in rows]
    gauges = [[form.gauge(values) for form in GAUGES] for values in numbers]
    texts = {
        "FORMS": [form.told() for form in GAUGES],
        "ROWS": numbers,
        "EXPECTED": [[[g.name, g.text, g.share, css(g.colour)] for g in row] for row in gauges],
    }
    script = GAUGE
    for name, content in texts.items():
        script = script.replace(name, json.dumps(content))
    run_in_node(script, "dials")
    assert gauges[1][3].text == "12°, sliding" and gauges[1][5].colour != gauges[0][5].colour


def test_requests_links_and_readouts():
    run_in_node(SCRIPT, "request", "readout")


def test_browsers_that_draw_by_software_are_known(tmp_path):
    script = """
    import assert from "node:assert";
    const { drawnBySoftware } = await import(VIEW);
    const named = (name, masked) => ({ getContext: () => ({
      RENDERER: 1,
      getExtension: () => (masked ? null : { UNMASKED_RENDERER_WEBGL: 2 }),
      getParameter: (which) => (which === 2 || masked ? name : "WebKit WebGL"),
    }) });
    const swift = "ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero) (0x0000C0DE)), SwiftShader driver)";
    assert.equal(drawnBySoftware(named(swift)), true);
    assert.equal(drawnBySoftware(named("llvmpipe (LLVM 15.0.6, 256 bits)", true)), true);
    assert.equal(drawnBySoftware(named("ANGLE (Intel, Mesa Intel(R) UHD Graphics 620, OpenGL 4.6)")), false);
    assert.equal(drawnBySoftware(named("WebKit WebGL", true)), false);
    """
    (tmp_path / "third_party/three/build").mkdir(parents=True)
    (tmp_path / "third_party/three/build/three.module.min.js").touch()
    shutil.copyfile(STATIC / "view.js", tmp_path / "view.js")
    run_in_node(script, "view", folder=tmp_path)


def run_in_node(script, *modules, folder=STATIC):
    """Run a script in which the upper-case names of modules stand for their addresses in a folder."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    for name in modules:
        script = script.replace(f"({name.upper()})", f"({json.dumps((folder / f'{name}.js').as_uri())})")
    done = subprocess.run(
        [node, "--input-type=module", "--no-warnings"], input=script, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
