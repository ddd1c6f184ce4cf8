"""Pictures of what ``collect_episodes`` has found, by the artists in them."""

import sys

import matplotlib
import numpy as np
import pytest
from gymnasium import spaces
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from simenv_marl import RULE, TRUNCATED
from simenv_marl.data import collect_episodes, plot_returns, plot_timeline
from simenv_marl.data.plots import COLOURS
from simenv_marl.data.timeline import UNKNOWN
from simenv_marl.errors import MissingExtraError, OptionValueError, UnknownAgentError
from tests.contract.test_simulate_many import ones
from tests.worlds.entities import Being, beings
from tests.worlds.models import Timed, calling, decision, script


@pytest.fixture(autouse=True)
def _without_windows():
    yield
    assert "matplotlib.pyplot" not in sys.modules or not matplotlib.pyplot.get_fignums()


def herd(number, steps, *, dying=(), policy=ones, key=Being.act, seeds=(5,), **definition):
    def main(simulation):
        simulation.crowd = [Being(place) for place in range(number)]
        for being in simulation.crowd:
            being.health = simulation.seed
        for step in range(steps):
            for being in list(simulation.crowd):
                being.act()
            for being in [
                being for being in simulation.crowd if being.number in dying and not step
            ]:
                being.leave()
                simulation.crowd.remove(being)
        return TRUNCATED

    policies = key if isinstance(key, dict) else {key: policy}
    return collect_episodes(script(main), policies, points=beings(**definition), seeds=seeds)


def answered(function, *answers):
    """An episode of a decision function, whose decisions are answered so."""
    remaining = iter(answers)
    return collect_episodes(
        calling(*[function] * len(answers)), {function: lambda seen: next(remaining)}, seeds=[1]
    )


def of(axes, kind):
    return [artist for artist in axes.collections if type(artist) is kind]


def dots(axes):
    """Where dots are, first the full ones of each line, then the hollow ones."""
    found = []
    for own in of(axes, PathCollection):
        places = np.ma.filled(own.get_offsets(), np.nan)
        colours = np.broadcast_to(own.get_facecolor(), (len(places), 4))
        full = np.array([to_hex(colour) != "#ffffff" for colour in colours], bool)
        seen = ~np.isnan(places).any(axis=1)
        for kind in (True, False):
            chosen = places[seen & (full == kind)].tolist()
            if chosen:
                found.append((chosen, kind))
    return found


def shades(cells):
    """The colour of each cell."""
    return [to_hex(colour) for colour in cells.to_rgba(cells.get_array())]


def texts(artist):
    return [text.get_text() for legend in artist.findobj(Legend) for text in legend.get_texts()]


def ticks(axes):
    return [label.get_text() for label in axes.get_yticklabels()]


def test_plot_timeline_shows_each_labelled_action_and_each_reward():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", reward_mapping=lambda: 2.0)
    answers = {ant: iter([1, 2, 3]), bee: iter([7, 8])}
    policies = {key: lambda observations, own=own: [next(own)] for key, own in answers.items()}
    found = collect_episodes(calling(ant, bee, ant, bee, ant), policies, seeds=[17])
    figure = plot_timeline(found)
    of_ant, paid_ant, of_bee, paid_bee = figure.axes
    assert "17" in figure.get_suptitle()
    assert dots(of_ant) == [([[0, 1], [2, 2], [4, 3]], True)]
    assert dots(of_bee) == [([[1, 7], [3, 8]], True)]
    bars = [line.tolist() for line in of(paid_bee, LineCollection)[0].get_segments()]
    assert bars == [[[1, 0], [1, 2]], [[3, 0], [3, 2]]]
    assert "decision" in paid_bee.get_xlabel()
    assert [axes.texts[0].get_text() for axes in (paid_ant, paid_bee)] == ["sum 0", "sum 4"]
    letters = list("abcdefghij")
    for given, names in (
        (None, ["1", "2", "3", "7", "8"]),
        (letters, ["b", "c", "d", "h", "i"]),
        ({1: "left"}, ["left", "2", "3", "7", "8"]),
        ({ant: {1: "dig"}, bee: letters}, ["dig", "2", "3", "h", "i"]),
    ):
        assert [
            name
            for axes in plot_timeline(found, action_names=given).axes[::2]
            for name in ticks(axes)
        ] == names
    with pytest.raises(OptionValueError, match="action_names"):
        plot_timeline(found, action_names="dig")


def test_plot_timeline_has_the_simulation_time_on_the_x_axis():
    def main(simulation):
        simulation.log.append(Being(0).act())  # whom the model has let go of lives to the end
        keeper = Being(1)
        for _ in range(3):
            simulation.log.append(keeper.act())

    bee = decision(agent="bee_0")  # who never decides, and so tells no time
    given = {"points": beings() | {bee: None}, "seeds": [1]}
    found = collect_episodes(lambda: Timed(main), {Being.act: ones, bee: ones}, **given)
    first, _, second, paid = plot_timeline(found).axes
    assert dots(first) == [([[0, 1]], True)]
    assert dots(second) == [([[10, 1], [20, 1], [30, 1]], True)]
    assert paid.get_xlabel() == "time"
    assert not first.patches
    assert [(patch.get_x(), patch.get_width()) for patch in second.patches] == [(0, 10)]
    for axes in (first, second):
        (ending,) = axes.lines[1:]
        assert (ending.get_xdata()[0], ending.get_marker()) == (40, "x")


@pytest.mark.parametrize("known", [False, True])
def test_plot_timeline_draws_decisions_of_the_rule_differently(known):
    names = {**dict(enumerate("abcdefghi")), 9: "rule"} if known else int
    ant = decision(agent="ant_0", action_space_mapping=names)
    found = answered(ant, [1], RULE, [3])
    by_policy, by_rule = dots(plot_timeline(found).axes[0])
    assert by_policy == ([[0, 1], [2, 3]], True)
    assert ([place for place, _ in by_rule[0]], by_rule[1]) == ([1], False)
    assert by_rule[0] == [[1, 9]] or not known
    assert texts(plot_timeline(found)) == ["policy", "rule", "terminated"]
    assert plot_timeline(found)._repr_png_().startswith(b"\x89PNG")  # for notebooks
    assert dots(plot_timeline(found[ant]).axes[0]) == [by_policy, by_rule]


def test_plot_timeline_has_a_chart_for_each_part_of_an_action():
    space = spaces.Dict(
        how=spaces.Box(0, 1, (2,), np.float32), what=spaces.Discrete(3), say=spaces.Text(9)
    )
    ant = decision(agent="ant_0", action_space=space)
    action = {"how": np.array([0.5, 0.25], np.float32), "what": 2, "say": "hello"}
    by_name = {
        axes.get_ylabel(): axes for axes in plot_timeline(answered(ant, [action], [action])).axes
    }
    assert set(by_name) == {"how", "what", "say", "reward"}
    assert dots(by_name["how"]) == [([[0, 0.5], [1, 0.5]], True), ([[0, 0.25], [1, 0.25]], True)]
    assert dots(by_name["what"]) == [([[0, 2], [1, 2]], True)]
    assert ticks(by_name["say"]) == ["hello"]
    assert {"how[0]", "how[1]"} <= set(texts(by_name["how"]))


def test_plot_timeline_shades_times_in_which_an_agent_is_not_alive():
    first, _, second, _, third, _ = plot_timeline(herd(3, 2, dying=[1])).axes
    # being_1, which has made the second of five decisions, goes after the third.
    assert [patch.get_x() for patch in second.patches] == [0, 3]
    assert [patch.get_x() for patch in third.patches] == [0]
    assert not first.patches
    assert [line.get_marker() for line in second.lines[1:]] == ["x"]
    assert [line.get_marker() for line in third.lines[1:]] == ["|"]


def drawn(axes):
    """The cells that are coloured over the white ones, as (begin, end, height in the middle)."""
    cells = [
        path.get_extents() for cells in of(axes, PolyCollection)[1:] for path in cells.get_paths()
    ]
    gap = 0.0 if len(cells) > 100 else 0.16  # which would hide what is slim
    assert all(cell.y1 - cell.y0 == pytest.approx(1 - gap) for cell in cells)
    return sorted((cell.x0, cell.x1, (cell.y0 + cell.y1) / 2) for cell in cells)


def test_plot_timeline_has_a_row_per_agent_and_some_can_be_chosen():
    found = herd(200, 3, dying=range(0, 200, 2))
    figure = plot_timeline(found)
    actions, rewards = figure.axes[:2]
    figure.canvas.draw()
    labels = list(filter(None, ticks(actions)))
    assert 10 < len(labels) < 60
    assert labels[0] == "being_0"
    cells = drawn(actions)
    assert (
        len(cells)
        == len(found[Being.act])
        == len(of(rewards, PolyCollection)[0].get_paths())
        == 400
    )
    # The first decides but once, at 0, and ends when all have decided; the second decides again
    # then.
    assert cells[:2] == [pytest.approx((0, 200, 0)), pytest.approx((1, 200, 1))]
    assert [line.get_marker() for line in actions.lines] == ["x", "|"] * 100
    figure = plot_timeline(found, agents=["being_7", "being_3"])
    assert [axes.get_title(loc="left") for axes in figure.axes[::2]] == [
        "being_7  (Being.act)",
        "being_3  (Being.act)",
    ]
    with pytest.raises(UnknownAgentError, match="being_200"):
        plot_timeline(found, agents=["being_200"])
    with pytest.raises(OptionValueError, match="agents"):
        plot_timeline(found, agents="being_7")


def test_plot_timeline_colours_rows_by_the_action():
    found = herd(
        8, 1, key=f"{Being.__module__}.Being.act", policy=lambda seen: [3, *[0] * 7][: len(seen)]
    )
    actions = plot_timeline(found, action_names=["stay", "1", "2", "go"]).axes[0]
    colours = set(map(to_rgba, shades(of(actions, PolyCollection)[-1])))
    assert colours <= {to_rgba(COLOURS[0]), to_rgba(COLOURS[3])}
    assert "go" in texts(actions)
    assert actions.get_title(loc="left") == "Being.act, 8 agents: action"


def test_plot_timeline_colours_rows_by_one_component_of_an_action():
    space = spaces.Dict(how=spaces.Box(0, 9, (2,), np.float32), far=spaces.Discrete(5))
    answer = {"how": np.array([1, 2], np.float32), "far": 4}
    found = herd(8, 1, policy=lambda seen: [answer] * len(seen), action_space=space)
    for component, name, value in (
        (None, "how[0]", 1),
        ("how[0]", "how[0]", 1),
        ("how[1]", "how[1]", 2),
    ):
        axes = plot_timeline(found, component=component).axes[0]
        assert set(of(axes, PolyCollection)[-1].get_array().tolist()) == {value}
        assert f"action {name}, one of 3" in axes.get_title(loc="left")
    assert "action far, one of 3" in plot_timeline(found, component="far").axes[0].get_title(
        loc="left"
    )
    with pytest.raises(OptionValueError, match=r"'how\[1\]'"):
        plot_timeline(found, component="where")


def test_plot_timeline_draws_unknown_rule_actions_grey():
    answers = iter([RULE])
    found = herd(8, 1, policy=lambda seen: next(answers, [2] * len(seen)), seeds=(5, 6))
    assert found[Being.act].by_rule.any()
    of_each = [plot_timeline(found, episode).axes[0] for episode in (0, 1)]
    cells = [shades(of(axes, PolyCollection)[-1]) for axes in of_each]
    assert any(UNKNOWN.lower() in colours for colours in cells)
    assert any("by rule, action unknown" in texts(axes.figure) for axes in of_each)
    plot_timeline(herd(8, 2, policy=lambda seen: RULE)).canvas.draw()  # by nobody but the rule


def test_plot_timeline_uses_a_colour_scale_for_numbers_and_many_actions():
    policies = {f"being_{place}": lambda seen, own=place: [own] * len(seen) for place in range(30)}
    many = herd(30, 1, key=policies, action_space=spaces.Discrete(40))
    given = {
        "action_space": spaces.Box(0, 9, (1,), np.float32),
        "observation_space_mapping": lambda being: [being.number, 0],
    }
    numbers = herd(10, 2, policy=lambda seen: (seen[:, :1] / 2).astype(np.float32), **given)
    for found, values, most in (
        (many, list(range(30)), 29),
        (numbers, np.repeat(np.arange(10) / 2, 2).tolist(), 4.5),
    ):
        scale = of(plot_timeline(found).axes[0], PolyCollection)[-1]
        assert scale.get_array().tolist() == values
        assert scale.get_clim() == (0, most)


def test_plot_timeline_episode_index_counts_from_either_end():
    ant = decision(agent="ant_0", reward_mapping=lambda: 3.0)
    main = lambda simulation: ant() if simulation.seed else None  # noqa: E731
    found = collect_episodes(script(main), {ant: ones}, seeds=[0, 8, 9])
    assert plot_timeline(found, np.int64(1)).get_suptitle() == "Episode 1, seed 8"
    assert plot_timeline(found, -1).get_suptitle() == "Episode 2, seed 9"
    with pytest.raises(OptionValueError, match=r"episode 0 \(seed 0\)"):
        plot_timeline(found, -3)
    for episode in (3, -4, 1.0, None):
        with pytest.raises(OptionValueError, match="episode"):
            plot_timeline(found, episode)
    for per in ("policy", "agent", "team"):
        assert [values for _, values in rows_of(plot_returns(found, per=per))] == [[3, 3]]
    with pytest.raises(OptionValueError, match="no agent has decided"):
        plot_returns(collect_episodes(script(main), {ant: ones}, seeds=[0]))


@pytest.mark.parametrize("draw", [plot_timeline, plot_returns])
def test_plots_refuse_invalid_data_and_name_the_missing_extra(draw, monkeypatch):
    for wrong in (None, {}, {"ant": 1}):
        with pytest.raises(OptionValueError, match="draw"):
            draw(wrong)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[plots\]"):
        draw(herd(1, 1))


def test_plots_draw_on_the_given_figure_or_axes():
    found = herd(8, 2)
    whole = Figure(figsize=(20, 8), layout="constrained")
    assert plot_timeline(found, figure=whole) is whole
    assert len(whole.axes) > 2
    assert whole.get_size_inches().tolist() == [20, 8]
    axes = Figure().subplots()
    assert plot_returns(found, ax=axes) is axes.figure


def paid_by_seed(number, factor=1.0):
    return herd(
        number,
        2,
        seeds=[1, 2, 6],
        reward_mapping=lambda being: being.health * factor + being.number,
    )


def rows_of(figure):
    """By the label of a row: where its points are."""
    (axes,) = figure.axes
    labels = dict(zip(np.round(axes.get_yticks(), 6).tolist(), ticks(axes), strict=True))
    means = {
        round(float(line.get_ydata()[0]), 6): float(line.get_xdata()[0]) for line in axes.lines
    }
    points = [np.asarray(drawn.get_offsets())[:, 0].tolist() for drawn in of(axes, PathCollection)]
    assert [np.mean(values) for values in points] == pytest.approx(list(means.values()))
    return [(labels[place], values) for place, values in zip(means, points, strict=True)]


@pytest.mark.parametrize(
    ("per", "rows"),
    [
        ("policy", {"Being.act": [3, 5, 13]}),
        ("agent", {"being_0": [2, 4, 12], "being_1": [4, 6, 14]}),
        ("team", {"": [6, 10, 26]}),
    ],
)
def test_plot_returns_shows_the_mean_one_agent_or_the_sum(per, rows):
    found = rows_of(plot_returns(paid_by_seed(2), per=per))
    assert [values for _, values in found] == list(rows.values())
    assert dict(found) == rows or per == "team"


def test_plot_returns_intervals_are_reproducible_and_cover_the_team():
    intervals = [plot_returns(paid_by_seed(3)).axes[0].texts[0].get_text() for _ in range(2)]
    assert intervals == ["8  [-5.145, 21.14]"] * 2  # by Student's t
    ant, bee = (
        decision(agent=name, reward_mapping=lambda paid=paid: paid)
        for name, paid in (("a", 1.0), ("b", 10.0))
    )
    found = collect_episodes(calling(ant, bee, ant), {ant: ones, bee: ones}, seeds=[3, 4])
    assert [values for _, values in rows_of(plot_returns(found, per="team"))] == [[12, 12]]


def test_plot_returns_shows_several_collections_side_by_side():
    several = {"once": paid_by_seed(3), "twice": paid_by_seed(3, 2.0)}
    figure = plot_returns(several)
    assert rows_of(figure) == [("once", [4, 6, 14]), ("twice", [6, 10, 26])]
    assert ticks(figure.axes[0]) == ["Being.act", "once", "twice"]
    alone = plot_returns({name: found[Being.act] for name, found in several.items()})
    assert rows_of(alone) == rows_of(figure)
    assert rows_of(plot_returns(several, per="team")) == [
        ("once", [12, 18, 42]),
        ("twice", [18, 30, 78]),
    ]


def test_plot_returns_refuses_hundreds_of_rows():
    many = herd(100, 1)
    for per, told in (("agent", "100 rows"), ("wolf", "per")):
        with pytest.raises(OptionValueError, match=told):
            plot_returns(many, per=per)
    plot_returns(many)
