"""The quickstart, run as its reader would run it: in a folder of its own."""

import re
import shutil

from .commands import python
from .page import DOCS


def test_quickstart_ppo_earns_more_than_the_models_rule(tmp_path):
    printed = python(shutil.copy(DOCS / "quickstart.py", tmp_path))
    earned = re.fullmatch(r"rule earns (\d+) a quarter\nPPO  earns (\d+) a quarter\n", printed)
    rule, learned = map(int, earned.groups())
    assert rule == 977
    assert learned > rule + 100
    assert "rule earns 977 a quarter" in (DOCS / "quickstart.md").read_text(encoding="utf-8")
