"""What the source distribution and the wheel in ``dist`` contain.

``make test-wheel`` builds them before.
"""

import subprocess
import tarfile
import zipfile
from pathlib import Path

import pytest

import simenv_marl

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tracked():
    """All files of the repository."""
    command = ["git", "ls-files", "-z", "--cached"]
    listed = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    ).stdout
    return {path for path in listed.split("\0") if path and (ROOT / path).exists()}


@pytest.fixture(scope="module")
def wheel():
    (path,) = (ROOT / "dist").glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_source_distribution_contains_the_repository(tracked):
    (path,) = (ROOT / "dist").glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert names == tracked | {"PKG-INFO"}


def test_wheel_contains_the_package_and_nothing_else(tracked, wheel):
    package = {path.removeprefix("src/") for path in tracked if path.startswith("src/simenv_marl/")}
    assert "simenv_marl/py.typed" in package
    described = f"simenv_marl-{simenv_marl.__version__}.dist-info/"
    about = {name.removeprefix(described) for name in wheel if name.startswith(described)}
    assert {name for name in wheel if not name.startswith(described)} == package
    assert about >= {"METADATA", "RECORD", "WHEEL", "licenses/LICENSE"}
    assert wheel[f"{described}licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()


def test_distribution_tests_use_the_installed_package(wheel):
    package = Path(simenv_marl.__file__).parent
    assert package.parent.name == "site-packages"
    for name, content in wheel.items():
        if name.startswith("simenv_marl/"):
            assert (package.parent / name).read_bytes() == content
