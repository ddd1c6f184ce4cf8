"""The quickstart, run as its reader would run it: in a folder of its own."""

import re
import shutil
import subprocess
import sys

from .page import DOCS


def test_ppo_earns_more_than_the_rule(tmp_path):
    shutil.copy(DOCS / "quickstart.py", tmp_path)
    done = subprocess.run(
        [sys.executable, "quickstart.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    rule, learned = map(
        int, re.fullmatch(r"rule earns (\d+) a quarter\nPPO  earns (\d+) a quarter\n", done.stdout).groups()
    )
    assert rule == 977
    assert learned > rule + 100
    assert "rule earns 977 a quarter" in (DOCS / "quickstart.md").read_text(encoding="utf-8")
