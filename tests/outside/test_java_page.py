"""The page on models in Java, as its reader would follow it."""

import re
import shutil
import subprocess

import pytest
from examples.jvm_market.build import CLIENT, java

from tests.clients.page import DOCS, blocks

pytestmark = pytest.mark.greenlet("the page takes the driver as it is")

PAGE = "clients-java.md"


def block(language):
    """The page's first block in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", (DOCS / PAGE).read_text(), re.MULTILINE | re.DOTALL)[0]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    try:
        java()
    except RuntimeError as error:
        pytest.skip(str(error))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_model_and_its_environment(folder, capsys):
    (folder / "Reservoir.java").write_text(block("java"))
    shutil.copy(CLIENT, folder)
    plain = subprocess.run(["sh", "-e"], input=block("sh"), capture_output=True, text=True, timeout=120)
    assert plain.stderr == ""
    exec(blocks(PAGE, "A model and its environment")[0], {"__name__": "__main__"})
    assert capsys.readouterr().out == plain.stdout != ""


def test_the_town(folder, capsys):
    (code,) = blocks(PAGE, "A town of farms and shops")
    names = {"__name__": "__main__"}
    exec(code, names)
    earned = names["found"].values()
    assert (earned["by the granary"] > earned["rule"]).mean() > 0.8
    assert "by the granary" in capsys.readouterr().out


def test_all_that_the_client_offers_is_named():
    text = (DOCS / PAGE).read_text()
    offered = set(
        re.findall(
            r"^    public static (?:<T> )?(?!final class|void main)\S+ (\w+)\(", CLIENT.read_text(), re.MULTILINE
        )
    )
    assert offered > {"decide", "decideInt", "run", "remove", "json"}
    assert {name for name in offered if name not in text} == set()
