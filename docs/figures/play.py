"""Play the greenhouse in two browsers, for the figures of docs/play.md.

Run it from the repository's root. It needs Playwright, and Chromium at ``/usr/bin/chromium``.
"""

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
COMMAND = [
    sys.executable,
    "-m",
    "simenv_marl",
    "play",
    "examples.greenhouse_coop.env:GreenhouseSim",
]


def decide(page: Any, value: str) -> None:
    """Enter an action."""
    page.locator("#decision:not([hidden]) #inputs input[type=number]").fill(value)
    page.locator("#decide").click()
    page.wait_for_selector("#decision", state="hidden")


def main() -> None:
    """Play five days, and take a picture of each browser."""
    from playwright.sync_api import sync_playwright

    server = subprocess.Popen(
        [*COMMAND, "--port", "0", "--seed", "3", "--title", "A greenhouse"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    lines = [server.stdout.readline() for _ in range(3)]
    links = [re.search(r"http\S+", line)[0] for line in lines]  # type: ignore[index]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        desktop = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
        phone = browser.new_context(
            viewport={"width": 390, "height": 844}, color_scheme="dark"
        ).new_page()
        desktop.goto(links[1])
        phone.goto(links[2])
        for day in range(5):
            decide(phone, f"0.{2 + day}")
            decide(desktop, f"0.0{7 - day}")
        for page, name, value in ((phone, "play-phone", "0.4"), (desktop, "play-desktop", "0.06")):
            page.wait_for_selector("#decision:not([hidden])")
            page.locator("#legend", has_text="16 futures").wait_for(timeout=300_000)
            page.screenshot(path=FOLDER / f"{name}.png")
            decide(page, value)
        browser.close()
    server.send_signal(signal.SIGINT)
    server.wait()


if __name__ == "__main__":
    main()
