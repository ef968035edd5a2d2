"""What is installed from an index: the wheel's content, and the commands outside of the repository."""

import os
import re
import signal
import site
import subprocess
import sys
import sysconfig
import tomllib
import urllib.request
from pathlib import Path

import pytest

from coachable import __version__, doctor

REPOSITORY = Path(__file__).resolve().parent.parent


def test_the_wheel_holds_everything_that_the_package_reads():
    wheel = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(REPOSITORY))
    shipped = {file.distribution_path for file in wheel.recurse_included_files()}
    package = (path for path in (REPOSITORY / "coachable").rglob("*") if path.is_file())
    present = {str(path.relative_to(REPOSITORY)) for path in package if "__pycache__" not in path.parts}
    assert present - shipped == set()
    assert {
        "coachable/py.typed",
        "coachable/fast/kernels.c",
        "coachable/fast/sac.c",
        "coachable/envs/racing/cars/gt3.toml",
    } <= shipped
    assert {"coachable/envs/combat/data/styles.csv", "coachable/pretrained/humanoid/weights.pt"} <= shipped
    assert all(name.startswith("coachable/") for name in shipped)
    assert set(wheel.metadata.core.license_files) == {"LICENSE", "NOTICE"}


def test_metadata_readme_and_doctor_name_the_same_versions_of_python():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    claimed = [line.rsplit(" ", 1)[1] for line in project["classifiers"] if re.search(r":: 3\.\d+$", line)]
    (_, first), (_, last) = doctor.PYTHON
    assert claimed == [f"3.{minor}" for minor in range(first, last + 1)]
    assert project["requires-python"] == f">=3.{first},<3.{last + 1}"
    assert f"Python {' or '.join(claimed)} with" in (REPOSITORY / "README.md").read_text()


def test_what_the_commands_write_is_not_tracked():
    ignored = (REPOSITORY / ".gitignore").read_text().splitlines()
    assert {"/evaluation/", "/report/", "/explanation/", "*.onnx", "/coachable.mp4", "/curves.png"} <= set(ignored)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The wheel in an environment of its own, which sees the dependencies of this one; and an empty folder."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(REPOSITORY)]
    subprocess.run(build, check=True)
    environment = folder / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    python = environment / "bin" / "python"
    (wheel,) = folder.glob("coachable-*.whl")
    subprocess.run([*pip, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel)], check=True)
    # Only the folder itself is added, so that an editable installation in it does not come along.
    packages = sysconfig.get_path("purelib", vars={"base": str(environment)})
    (Path(packages) / "dependencies.pth").write_text("\n".join(site.getsitepackages()))
    empty = folder / "empty"
    empty.mkdir()
    return environment / "bin", empty


def _outside(installed, *command, **options):
    scripts, folder = installed
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    arguments = [str(scripts / command[0]), *command[1:]]
    return subprocess.Popen(
        arguments, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (["python", "-c", "import coachable; print(coachable.__file__)"], "environment/lib"),
        (["coachable", "--version"], __version__),
        (["coachable", "doctor"], "torch"),
        (["coachable", "evaluate", "humanoid", "--episodes=1", "--switch-episodes=1", "--steps=5"], "# humanoid"),
    ],
)
def test_commands_work_outside_of_the_repository(installed, command, expected):
    process = _outside(installed, *command)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert expected in output


@pytest.mark.slow
def test_the_page_is_served_outside_of_the_repository(installed):
    pytest.importorskip("viser")
    with _outside(installed, "coachable", "coach", "humanoid", "--port=18080") as process:
        assert process.stdout is not None
        try:
            address = re.search(r"http://[\w.:]+", process.stdout.readline())
            assert address
            with urllib.request.urlopen(address[0], timeout=60) as answer:
                assert answer.status == 200
            assert process.poll() is None
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0, process.stdout.read()
