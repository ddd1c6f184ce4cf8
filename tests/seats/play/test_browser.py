"""Two people play the greenhouse in their browsers, by keyboard, to the end of an episode."""

import json
from pathlib import Path

import pytest
from examples.greenhouse_coop.env import GreenhouseSim

from simenv_marl.seats.play import replay
from tests.seats.play.test_server import Server

CHROMIUM = Path("/usr/bin/chromium")
playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"needs {CHROMIUM}")

FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]


@pytest.fixture
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def start():
    servers = []

    def make(*arguments, **options):
        servers.append(Server(*arguments, **options))
        return servers[-1]

    yield make
    for server in servers:
        if server.process.poll() is None:
            server.end()


@pytest.fixture
def open_page(browser):
    problems = []

    def make(server, seat, **context):
        page = browser.new_context(**context).new_page()
        page.set_default_timeout(60_000)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on(
            "console",
            lambda message: problems.append(message.text) if message.type == "error" else None,
        )
        page.goto(f"{server.base}seat/{seat}?key={server.keys(seat)[0]}" if seat else server.base)
        return page

    yield make
    assert problems == []


def decide(page, value):
    """Enter a value, with the keyboard alone."""
    page.wait_for_selector("#decision:not([hidden]) input:focus")
    page.keyboard.press("Control+a")
    page.keyboard.type(value)
    page.keyboard.press("Enter")
    page.wait_for_selector("#decision", state="hidden")


def wait_for_turn(page, turn):
    page.locator("#facts", has_text=f"Decision {turn},").wait_for()


def test_two_people_play_the_greenhouse_to_its_end(open_page, start, tmp_path):
    path = tmp_path / "game.jsonl"
    server = start(
        "--seed",
        "3",
        "--record",
        str(path),
        simulation="examples.greenhouse_coop.env:GreenhouseSim",
    )
    airing = open_page(
        server, "ventilator_0", viewport={"width": 390, "height": 844}, color_scheme="dark"
    )
    watering = open_page(server, "waterer_0", viewport={"width": 1280, "height": 800})
    watering.locator("#status", has_text="Waiting for ventilator_0").wait_for()

    # Futures of each candidate, and of the action that the person has entered; the rule's action.
    airing.wait_for_selector("#actions svg polygon")
    airing.get_by_text("The rule: 0.2").wait_for()
    airing.locator("#inputs input[type=number]").fill("0.31")
    airing.get_by_text("What then?").click()
    airing.locator("#actions button", has_text="0.31").locator("svg").wait_for()
    airing.locator("#inputs input[type=number]").fill("7")
    airing.keyboard.press("Enter")
    airing.locator("#problem", has_text="7").wait_for()

    for _ in range(3):
        decide(airing, "0.3")
        decide(watering, "0.05")
    decide(airing, "0.4")
    watering.wait_for_selector("#decision:not([hidden])")
    shown = watering.locator("#facts, #charts b").all_inner_texts()
    watering.reload()
    watering.wait_for_selector("#decision:not([hidden])")
    assert watering.locator("#facts, #charts b").all_inner_texts() == shown
    assert len(watering.locator("#charts polyline").all()) == 6

    watering.locator("#undo").click()
    watering.locator("#turn", has_text="5 of 7").wait_for()
    watering.locator("#inputs input[type=number]").focus()
    decide(watering, "0.06")  # which forgets what came after it
    decide(airing, "0.5")
    watering.wait_for_selector("#decision:not([hidden])")
    for page in (airing, watering):
        page.locator("#many").fill("200")
        page.locator("#delegate").click()
    for page in (airing, watering):
        page.locator("#status", has_text="The episode is over").wait_for()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    history = airing.evaluate("state.history")
    code, _, err = server.end()
    assert (code, err) == (0, "")

    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["action"] for line in lines if line.get("turn") == 5] == [[0.05], [0.06]]
    found = replay(path, GreenhouseSim)
    for agent, trajectories in found.items():
        assert trajectories.rewards.tolist() == [
            row["reward"] for row in history if row["agent"] == agent
        ]
    assert found["waterer_0"].actions[:3, 0].tolist() == pytest.approx([0.05, 0.05, 0.06])
    assert not found["waterer_0"].by_rule[:3].any()
    assert found["waterer_0"].by_rule[3:].all()


def test_buttons_and_grids_are_played_by_keys_and_texts_of_the_game_are_no_markup(open_page, start):
    server = start("--seed", "3", "--limit", "300")
    buyer, seller = open_page(server, "buyer"), open_page(server, "seller")
    assert buyer.locator("#actions button").first.inner_text().startswith("1")
    buyer.keyboard.press("3")  # the third: two pieces
    seller.wait_for_selector("#decision:not([hidden])")
    seller.locator("fieldset").nth(1).locator("label", has_text="2").click()
    seller.get_by_text("Decide Enter").click()
    wait_for_turn(buyer, 2)
    assert buyer.evaluate("state.history.slice(0, 2).map((row) => row.action)") == [2, [0, 2]]
    buyer.wait_for_selector("#image")
    assert "s left" in buyer.locator("#facts").inner_text()
    buyer.evaluate("problem('<img src=x onerror=alert(1)>')")
    assert buyer.locator("#problem img").count() == 0
    buyer.keyboard.press("u")
    wait_for_turn(buyer, 0)
    buyer.keyboard.press("y")
    wait_for_turn(buyer, 2)
    buyer.keyboard.press("r")
    wait_for_turn(seller, 3)
    assert seller.evaluate("state.history[2].by") == "rule"
    spectator = open_page(server, "")
    # and sees the futures, and has no controls
    spectator.get_by_text("Decide for seller").wait_for()
    spectator.wait_for_selector("#actions polygon")
    spectator.keyboard.press("r")
    assert spectator.evaluate(
        "document.querySelector('#decision').inert && document.querySelector('#controls').hidden"
    )
    assert server.end()[0] == 0
