"""People play in their browsers: what they see, what decides, and what is told."""

import json
import os
import signal
import socket
from pathlib import Path

import pytest
from examples.greenhouse_coop.env import GreenhouseSim
from examples.market_seats.env import Free

from simenv_marl.seats.play import replay
from tests.seats.play.test_server import Server

CHROMIUM = Path("/usr/bin/chromium")
playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"needs {CHROMIUM}")

FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
GREENHOUSE = "examples.greenhouse_coop.env:GreenhouseSim"
MARKET = "examples.market_seats.env:Free"
QUEUE = "examples.queue_admission.env:QueueSimulation"
PHONE = {"viewport": {"width": 390, "height": 844}}
DESKTOP = {"viewport": {"width": 1280, "height": 800}}
REFUSED = "ERR_CONNECTION_REFUSED"


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

    def note(message):
        if message.type == "error" and REFUSED not in message.text:  # while there is no server
            problems.append(message.text)

    def make(server, seat, path="", **context):
        page = browser.new_context(**context).new_page()
        page.set_default_timeout(60_000)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", note)
        key = f"seat/{seat}?key={server.keys(seat)[0]}" if seat else path
        page.goto(f"{server.base}{key}")
        return page

    yield make
    assert problems == []


def wait_for_turn(page):
    page.wait_for_selector("#decision:not([hidden]) #decide")


def enter(page, value):
    """Enter a value, with the keyboard alone."""
    page.wait_for_selector("#decision:not([hidden]) input:focus")
    page.keyboard.press("Control+a")
    page.keyboard.type(value)
    page.keyboard.press("Enter")
    page.wait_for_selector("#decision", state="hidden")


def choose(page, text):
    page.locator(".card", has_text=text).first.click()
    page.locator("#decide").click()


def rows(page):
    return page.locator("#rows tr").all_inner_texts()


def fits(page):
    """Whether the question, the situation, the answers and the button are on the screen."""
    boxes = [
        page.locator(place).bounding_box()
        for place in ("#title", "#question", "#situation", "#inputs", "#answers", "#decide")
    ]
    height = page.viewport_size["height"]
    wide = page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    return wide and all(box is None or box["y"] + box["height"] <= height for box in boxes)


@pytest.mark.parametrize("model", [GREENHOUSE, QUEUE])
def test_play_page_shows_a_decision_on_one_screen_of_a_phone(open_page, start, model):
    server = start("--seed", "3", "--title", "A day in the greenhouse", simulation=model)
    seat = "ventilator_0" if model == GREENHOUSE else "admission_0"
    page = open_page(server, seat, **PHONE)
    wait_for_turn(page)
    page.wait_for_selector(".card svg polyline")
    assert fits(page)
    assert page.locator("#title").inner_text() == "A day in the greenhouse"
    assert page.locator("#undo").is_hidden()
    assert server.end()[0] == 0


def test_play_page_lets_two_people_play_the_greenhouse(open_page, start, tmp_path):
    path = tmp_path / "game.jsonl"
    server = start("--seed", "3", "--record", str(path), simulation=GREENHOUSE)
    airing = open_page(server, "ventilator_0", color_scheme="dark", **PHONE)
    airing.wait_for_selector("#decision:not([hidden])")
    watering = open_page(server, "waterer_0", **DESKTOP)
    watering.locator("#status", has_text="Waiting for ventilator_0").wait_for()
    assert "22 °C" in airing.locator("#situation").inner_text().replace("21 °C", "22 °C")

    # Futures of each candidate, and of the action that the person has entered; the rule's action.
    airing.locator(".card", has_text="By the rule: 0.2").wait_for()
    airing.locator("#legend", has_text="Your points after 8 decisions").wait_for()
    number = airing.locator("#inputs input[type=number]")
    assert number.input_value() == "0.2"
    number.fill("0.31")
    airing.get_by_text("What then?").click()
    airing.locator(".card", has_text="0.31").locator("svg").wait_for()
    number.fill("7")
    airing.keyboard.press("Enter")
    airing.locator(".field .wrong", has_text="Enter a number from 0 to 1").wait_for()
    assert airing.locator("#decision").is_visible()

    enter(airing, "0.3")
    enter(watering, "0.05")
    wait_for_turn(airing)
    assert number.input_value() == "0.3"  # the last value of the person
    airing.keyboard.press("Enter")  # decides nothing, because nothing was touched
    airing.locator("#problem", has_text="first").wait_for()
    enter(airing, "0.3")
    enter(watering, "0.05")
    enter(airing, "0.4")
    wait_for_turn(watering)
    assert rows(watering)[0].split("\t")[1:3] == ["ventilator_0", "share of the air: 0.4"]
    shown = watering.locator("#facts, #situation b").all_inner_texts()
    watering.reload()
    wait_for_turn(watering)
    assert watering.locator("#facts, #situation b").all_inner_texts() == shown
    assert watering.locator("#situation polyline").count() > 3

    watering.locator("#tools summary").click()
    watering.locator("#undo").click()
    airing.locator("#event", has_text="waterer_0 went back to decision 4").wait_for()
    wait_for_turn(watering)
    watering.locator("#inputs input[type=number]").focus()
    enter(watering, "0.06")  # which forgets what came after it
    enter(airing, "0.5")
    wait_for_turn(watering)
    airing.locator("#tools summary").click()
    for page in (airing, watering):
        page.locator("#many").fill("200")
        page.locator("#delegate").click()
    for page in (airing, watering):
        page.locator("#ending", has_text="come to its end").wait_for()
        page.locator("#compared", has_text="if the rule had decided").wait_for()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    total = float(airing.locator("#totals tr", has_text="ventilator_0").locator("b").inner_text())
    code, _, err = server.end()
    assert (code, err) == (0, "")

    lines = [json.loads(line) for line in path.read_text().splitlines()]
    actions = [
        line["action"]["array"] for line in lines if "agent" in line and line["play"]["turn"] == 3
    ]
    assert [action for [action] in actions] == pytest.approx([0.05, 0.06])
    found = replay(path, GreenhouseSim)
    assert found["ventilator_0"].returns[0] == pytest.approx(total, abs=0.01)
    assert found["waterer_0"].actions[:2, 0].tolist() == pytest.approx([0.05, 0.06])
    assert not found["waterer_0"].by_rule[:2].any()
    assert found["waterer_0"].by_rule[2:].all()


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def test_play_page_continues_the_game_after_a_crash_of_the_server(open_page, start, tmp_path):
    path, port = tmp_path / "game.jsonl", str(free_port())
    arguments = [
        "--seat", "trader_0", "trader_1", "--policy", "trader_2=tests.worlds.seats:five",
        "--port", port, "--record", str(path), "--time-unit", "round",
    ]  # fmt: skip
    server = start("--seed", "3", *arguments, simulation=MARKET)
    lobby = open_page(server, "", **PHONE)
    lobby.locator("li", has_text="the policy five").wait_for()
    lobby.locator("li", has_text="trader_0").get_by_text("Take").click()
    first = lobby
    wait_for_turn(first)
    second = open_page(server, "trader_1", **DESKTOP)
    choose(first, "3 crates")
    for number in (2, 5):  # each round, another one is first
        second.locator("#facts", has_text=f"Decision {number}.").wait_for()
        choose(second, "2 crates")
    wait_for_turn(first)
    choose(first, "4 crates")
    first.locator("#facts", has_text="Decision 11.").wait_for()
    choose(first, "4 crates")
    second.locator("#facts", has_text="Decision 12.").wait_for()
    wait_for_turn(second)
    before = rows(second), second.locator("#facts").inner_text()
    assert any("trader_2\t5 crates\tpolicy" in row for row in before[0])
    os.killpg(server.process.pid, signal.SIGKILL)
    server.process.communicate()
    first.locator("#status", has_text="The connection is lost").wait_for()
    assert second.evaluate("document.querySelector('main').inert")

    server = start(*arguments, simulation=MARKET)
    wait_for_turn(second)
    second.wait_for_selector("body:not(.dead)")
    assert (rows(second), second.locator("#facts").inner_text()) == before
    choose(second, "6 crates")
    wait_for_turn(first)
    first.locator("#tools summary").click()
    first.locator("#restart").click()
    first.locator("#yes").click()
    second.locator("#event", has_text="trader_0 began another game").wait_for()
    wait_for_turn(first)
    first.locator("#redo").click()
    second.locator("#event", has_text="went back to the game before").wait_for()
    second.locator("#tools summary").click()
    for page in (first, second):
        page.locator("#many").fill("100")
        page.locator("#delegate").click()
    second.locator("#ending").wait_for()
    assert server.end()[0] == 0
    found = replay(path, Free)
    assert found["trader_1"].actions[:3].tolist() == [2, 2, 6]
    assert set(found["trader_2"].actions.tolist()) == {5}


def test_play_page_takes_keys_for_cards_and_grids_and_escapes_texts(open_page, start):
    server = start("--seed", "3", "--limit", "300")
    buyer, seller = open_page(server, "buyer"), open_page(server, "seller")
    wait_for_turn(buyer)
    assert buyer.locator(".card kbd").all_inner_texts() == ["0", "1", "2", "3", "r"]
    assert buyer.locator("#decide").is_disabled()
    buyer.keyboard.press("2")
    assert buyer.locator(".card[aria-checked=true]").count() == 1
    buyer.keyboard.press("Enter")
    wait_for_turn(seller)
    seller.keyboard.press("Enter")
    seller.locator("#problem", has_text="first").wait_for()
    seller.locator("fieldset").nth(1).locator("label", has_text="2").click()
    seller.locator("#decide").click()
    seller.locator(".field .wrong", has_text="Choose one of these").first.wait_for()
    seller.locator("fieldset").nth(0).locator("label", has_text="0").click()
    seller.locator("#decide").click()
    wait_for_turn(buyer)
    assert [row.split("\t")[2] for row in rows(buyer)] == ["Part 1: 0, Part 2: 2", "2"]
    assert buyer.locator("#clock").inner_text().endswith(" s")
    buyer.wait_for_selector("#image")
    buyer.evaluate("document.getElementById('problem').textContent = '<img src=x>'")
    assert buyer.locator("#problem img").count() == 0
    spectator = open_page(server, "", "watch")
    spectator.locator("#question").wait_for()
    spectator.wait_for_selector(".card polygon")
    assert spectator.locator("button:enabled:visible").count() == 0
    spectator.keyboard.press("2")
    spectator.keyboard.press("Enter")
    assert buyer.locator("#decision").is_visible()
    second = open_page(server, "buyer")
    second.locator("#event", has_text="open in 2 pages").wait_for()
    assert server.end()[0] == 0


def test_play_page_reports_a_slow_model_and_ignores_double_clicks(open_page, start, tmp_path):
    path = tmp_path / "game.jsonl"
    server = start("--record", str(path), simulation="tests.worlds.seats:SlowShop")
    page = open_page(server, "buyer")
    wait_for_turn(page)
    page.locator("#legend", has_text="computed").wait_for()  # futures take long, too
    page.locator(".card").nth(1).click()
    page.evaluate(
        "document.getElementById('decide').dispatchEvent(new MouseEvent('click', {detail: 1}))"
    )
    page.locator("#status", has_text="The simulation computes").wait_for(timeout=200)
    page.evaluate(
        "document.getElementById('decide').dispatchEvent(new MouseEvent('click', {detail: 1}))"
    )
    page.locator("#facts", has_text="Decision 2.").wait_for(timeout=10_000)
    assert path.read_text().count('"agent"') == 1
    assert server.end()[0] == 0


def test_play_page_shows_the_last_seconds_and_rejects_a_wrong_key(open_page, start):
    server = start("--limit", "11", "--tools", "facilitator", "--seat", "buyer")
    page = open_page(server, "buyer", **PHONE)
    page.wait_for_selector("#clock.late")
    assert page.locator("#tools").is_hidden()
    facilitator = open_page(server, "", server.facilitator, **DESKTOP)
    page.locator("#rows", has_text="as time was up").wait_for()
    facilitator.locator("#tools summary").click()
    facilitator.locator("#undo").click()
    page.locator("#event", has_text="The facilitator went back").wait_for()
    stranger = open_page(server, "", "seat/buyer?key=0")
    stranger.locator("#status", has_text="ask for the link").wait_for()
    assert stranger.locator("main").is_hidden()
    assert server.end()[0] == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_play_page_works_for_agents_with_special_characters_in_names(open_page, start, scheme):
    server = start("--seed", "1", simulation="tests.worlds.seats:OddShop")
    lobby = open_page(server, "", color_scheme=scheme)
    lobby.get_by_text("Take").first.click()
    wait_for_turn(lobby)
    assert lobby.locator("#seat").inner_text() == "../a b/ü?&<i>"
    choose(lobby, "1")
    lobby.locator("#facts", has_text="Decision 2.").wait_for()
    assert server.end()[0] == 0
