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
from tests.worlds.many_worlds import Being, beings
from tests.worlds.models import Script, calling, decision, script


@pytest.fixture(autouse=True)
def _without_windows():
    yield
    assert "matplotlib.pyplot" not in sys.modules or not matplotlib.pyplot.get_fignums()


def ones(observations):
    return np.ones(len(observations), np.int64)


def clocked(main):
    class Clocked(Script):
        def time(self):
            return 10.0 * len(self.log)

    return lambda: Clocked(main)


def herd(number, steps, *, dying=()):
    """A simulation in which beings act in turns; some are banished after their first step."""

    def main(simulation):
        simulation.crowd = [Being(place) for place in range(number)]
        for step in range(steps):
            for being in list(simulation.crowd):
                being.act()
            for being in [being for being in simulation.crowd if being.number in dying and not step]:
                being.leave()
                simulation.crowd.remove(being)
        return TRUNCATED

    return script(main)


def of(axes, kind):
    return [artist for artist in axes.collections if type(artist) is kind]


def dots(axes):
    """Of each collection of dots that is not empty: where they are, and whether they are filled."""
    found = []
    for drawn in of(axes, PathCollection):
        if len(drawn.get_offsets()):
            filled = to_hex(drawn.get_facecolor()[0]) != to_hex("white")
            found.append((np.asarray(drawn.get_offsets()).tolist(), filled))
    return found


def texts(axes):
    return [text.get_text() for legend in axes.findobj(Legend) for text in legend.get_texts()]


# -- few agents -----------------------------------------------------------------------------------


def test_charts_show_each_action_and_each_reward():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", reward_mapping=lambda: 2.0)
    answers = {ant: iter([3, 4, 5]), bee: iter([7, 8])}
    policies = {key: lambda observations, own=own: [next(own)] for key, own in answers.items()}
    found = collect_episodes(calling(ant, bee, ant, bee, ant), policies, seeds=[17])
    figure = plot_timeline(found)
    of_ant, paid_ant, of_bee, paid_bee = figure.axes
    assert "17" in figure.get_suptitle()
    assert dots(of_ant) == [([[0, 3], [2, 4], [4, 5]], True)]
    assert dots(of_bee) == [([[1, 7], [3, 8]], True)]
    assert [line.tolist() for line in of(paid_bee, LineCollection)[0].get_segments()] == [
        [[1, 0], [1, 2]],
        [[3, 0], [3, 2]],
    ]
    assert "decision" in paid_bee.get_xlabel()
    assert [label.get_text() for label in of_ant.get_yticklabels()] == ["3", "4", "5"]
    assert "sum 4" in [text.get_text() for text in paid_bee.texts]
    assert "sum 0" in [text.get_text() for text in paid_ant.texts]


def test_the_clock_is_what_runs_from_left_to_right():
    def main(simulation):
        for _ in range(3):
            simulation.log.append(ant())

    ant = decision(agent="ant_0")
    bee = decision(agent="bee_0")  # who never decides, and so tells no time
    policies = {ant: lambda seen: [1], bee: lambda seen: [1]}
    figure = plot_timeline(collect_episodes(clocked(main), policies, seeds=[1]))
    assert dots(figure.axes[0]) == [([[0, 1], [10, 1], [20, 1]], True)]
    assert figure.axes[-1].get_xlabel() == "time"
    (ending,) = figure.axes[0].lines[1:]
    assert (ending.get_xdata()[0], ending.get_marker()) == (30, "x")


def test_what_the_rule_has_decided_is_told_apart():
    ant = decision(agent="ant_0")
    answers = iter([[1], RULE, [3]])
    figure = plot_timeline(collect_episodes(calling(ant, ant, ant), {ant: lambda seen: next(answers)}, seeds=[1]))
    by_policy, by_rule = dots(figure.axes[0])
    assert by_policy == ([[0, 1], [2, 3]], True)
    assert [place for place, _ in by_rule[0]] == [1]
    assert not by_rule[1]
    assert texts(figure.axes[0]) == ["policy", "rule", "terminated"]


def test_actions_have_names():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    policies = {"ant_0": lambda seen: [1], "bee_0": lambda seen: [2]}
    found = collect_episodes(calling(ant, bee), policies, points=[ant, bee], seeds=[1])

    def names(**options):
        return [[tick.get_text() for tick in axes.get_yticklabels()] for axes in plot_timeline(found, **options).axes]

    assert names(action_names=["no", "left", "right"])[::2] == [["left"], ["right"]]
    assert names(action_names={1: "left"})[::2] == [["left"], ["2"]]
    assert names(action_names={"ant_0": {1: "dig"}, "bee_0": ["a", "b", "fly"]})[::2] == [["dig"], ["fly"]]
    with pytest.raises(OptionValueError, match="action_names"):
        plot_timeline(found, action_names="dig")


def test_actions_of_several_parts_have_a_chart_for_each_part():
    space = spaces.Dict(how=spaces.Box(0, 1, (2,), np.float32), what=spaces.Discrete(3), say=spaces.Text(9))
    ant = decision(agent="ant_0", action_space=space)

    def policy(seen):
        return [{"how": np.array([0.5, 0.25], np.float32), "what": 2, "say": "hello"}] * len(seen)

    figure = plot_timeline(collect_episodes(calling(ant, ant), {ant: policy}, seeds=[1]))
    by_name = {axes.get_ylabel(): axes for axes in figure.axes}
    assert set(by_name) == {"how", "what", "say", "reward"}
    assert dots(by_name["how"]) == [([[0, 0.5], [1, 0.5]], True), ([[0, 0.25], [1, 0.25]], True)]
    assert dots(by_name["what"]) == [([[0, 2], [1, 2]], True)]
    assert [tick.get_text() for tick in by_name["say"].get_yticklabels()] == ["hello"]
    assert {"how[0]", "how[1]"} <= set(texts(by_name["how"]))


def test_parts_of_tuples_are_counted():
    space = spaces.Tuple([spaces.Discrete(3), spaces.Dict(far=spaces.Box(0, 9, (1,), np.float32))])
    ant = decision(agent="ant_0", action_space=space)
    answer = (2, {"far": np.array([0.5], np.float32)})
    figure = plot_timeline(collect_episodes(calling(ant), {ant: lambda seen: [answer]}, seeds=[1]))
    assert [axes.get_ylabel() for axes in figure.axes] == ["[0]", "[1]['far']", "reward"]
    assert [dots(axes) for axes in figure.axes[:2]] == [[([[0, 2]], True)], [([[0, 0.5]], True)]]


def test_one_decision_alone_can_be_drawn():
    ant = decision(agent="ant_0", action_space=spaces.Box(0, 1, (1,)))
    figure = plot_timeline(collect_episodes(calling(ant), {ant: lambda seen: [[0.5]]}, seeds=[1]))
    assert dots(figure.axes[0]) == [([[0, 0.5]], True)]
    low, high = figure.axes[0].get_ylim()
    assert low < 0.5 < high
    figure.canvas.draw()


def test_where_nobody_lives_is_shaded():
    figure = plot_timeline(collect_episodes(herd(3, 2, dying=[1]), {Being.act: ones}, points=beings(), seeds=[1]))
    first, _, second, _, third, _ = figure.axes
    # being_1, which has made the second of five decisions, goes after the third.
    assert [patch.get_x() for patch in second.patches] == [0, 3]
    assert [patch.get_x() for patch in third.patches] == [0]
    assert not first.patches
    assert [line.get_marker() for line in second.lines[1:]] == ["x"]
    assert [line.get_marker() for line in third.lines[1:]] == ["|"]


def test_whom_the_model_has_let_go_of_lives_to_the_end():
    def main(simulation):
        simulation.log.append(Being(0).act())
        keeper = Being(1)
        for _ in range(3):
            simulation.log.append(keeper.act())

    figure = plot_timeline(collect_episodes(clocked(main), {Being.act: ones}, points=beings(), seeds=[1]))
    assert not figure.axes[0].patches
    assert [(patch.get_x(), patch.get_width()) for patch in figure.axes[2].patches] == [(0, 10)]


# -- many agents ----------------------------------------------------------------------------------


def drawn(axes):
    """The cells that are coloured over the white ones, as (begin, end, height in the middle)."""
    cells = [path.get_extents() for cells in of(axes, PolyCollection)[1:] for path in cells.get_paths()]
    gap = 0.0 if len(cells) > 100 else 0.16  # which would hide what is slim
    assert all(cell.y1 - cell.y0 == pytest.approx(1 - gap) for cell in cells)
    return sorted((cell.x0, cell.x1, (cell.y0 + cell.y1) / 2) for cell in cells)


def test_many_agents_have_a_row_each():
    found = collect_episodes(herd(200, 3, dying=range(0, 200, 2)), {Being.act: ones}, points=beings(), seeds=[5])
    figure = plot_timeline(found)
    actions, rewards = figure.axes[:2]
    figure.canvas.draw()
    labels = [label.get_text() for label in actions.get_yticklabels() if label.get_text()]
    assert 10 < len(labels) < 60
    assert labels[0] == "being_0"
    cells = drawn(actions)
    assert len(cells) == len(found[Being.act]) == 400
    # The first decides but once, at 0, and ends when all have decided; the second decides again then.
    assert cells[0] == pytest.approx((0, 200, 0))
    assert cells[1] == pytest.approx((1, 200, 1))
    assert len(of(rewards, PolyCollection)[0].get_paths()) == 400
    crosses, dashes = actions.lines
    assert (crosses.get_marker(), len(crosses.get_xdata())) == ("x", 100)
    assert (dashes.get_marker(), len(dashes.get_xdata())) == ("|", 100)


def test_rows_are_coloured_by_the_action():
    found = collect_episodes(
        herd(8, 1), {Being.act: lambda seen: [3, *[0] * 7][: len(seen)]}, points=beings(), seeds=[5]
    )
    figure = plot_timeline(found, action_names=["stay", "1", "2", "go"])
    actions = figure.axes[0]
    colours = [tuple(colour) for colour in of(actions, PolyCollection)[-1].get_facecolor()]
    assert set(colours) <= {to_rgba(COLOURS[0]), to_rgba(COLOURS[3])}
    assert "go" in texts(actions)


def test_one_dimensional_actions_have_a_scale():
    space = spaces.Box(0, 9, (1,), np.float32)
    policy = lambda seen: (seen[:, :1] / 2).astype(np.float32)  # noqa: E731
    points = beings(action_space=space, observation_space_mapping=lambda being: [being.number, 0])
    found = collect_episodes(herd(10, 2), {Being.act: policy}, points=points, seeds=[5])
    scale = of(plot_timeline(found).axes[0], PolyCollection)[-1]
    assert scale.get_array().tolist() == [number / 2 for number in range(10) for _ in range(2)]
    assert scale.get_clim() == (0, 4.5)


def test_rows_of_actions_with_components_are_coloured_by_one():
    space = spaces.Dict(how=spaces.Box(0, 9, (2,), np.float32), far=spaces.Discrete(5))
    points = beings(action_space=space)
    answer = {"how": np.array([1, 2], np.float32), "far": 4}
    found = collect_episodes(herd(8, 1), {Being.act: lambda seen: [answer] * len(seen)}, points=points, seeds=[5])

    def values(component):
        return set(of(plot_timeline(found, component=component).axes[0], PolyCollection)[-1].get_array().tolist())

    assert values("how[0]") == {1}
    assert values("how[1]") == {2}
    assert "how[0], one of 3" in plot_timeline(found).axes[0].get_title(loc="left")
    assert "action far, one of 3" in plot_timeline(found, component="far").axes[0].get_title(loc="left")
    with pytest.raises(OptionValueError, match=r"'how\[1\]'"):
        plot_timeline(found, component="where")


def test_what_only_the_rule_knows_is_grey():
    answers = iter([RULE])
    policy = lambda seen: next(answers, [2] * len(seen))  # noqa: E731
    found = collect_episodes(herd(8, 1), {Being.act: policy}, points=beings(), seeds=[5, 6])
    assert found[Being.act].by_rule.any()
    of_each = [plot_timeline(found, episode).axes[0] for episode in (0, 1)]
    greys = [
        to_hex(cells.get_facecolor()[0]) == UNKNOWN.lower()
        for axes in of_each
        for cells in of(axes, PolyCollection)
        if len(cells.get_facecolor())
    ]
    assert any(greys)
    assert any("by rule, action unknown" in texts(axes.figure.axes[1]) for axes in of_each)


def test_policies_are_called_by_the_last_of_their_dotted_names():
    for key in (Being.act, f"{Being.__module__}.Being.act"):
        found = collect_episodes(herd(8, 1), {key: ones}, points=beings(), seeds=[5])
        assert plot_timeline(found).axes[0].get_title(loc="left") == "Being.act, 8 agents: action"


def test_nobody_but_the_rule_can_be_drawn():
    found = collect_episodes(herd(8, 2), {Being.act: lambda seen: RULE}, points=beings(), seeds=[5])
    plot_timeline(found).canvas.draw()


def test_policies_have_panels_of_their_own_unless_they_are_many():
    def collected(number):
        names = [f"being_{place}" for place in range(number)]
        return collect_episodes(herd(number, 2), dict.fromkeys(names, ones), points=beings(), seeds=[5])

    assert len(plot_timeline(collected(4)).axes) == 8
    many = plot_timeline(collected(30))
    assert [axes.get_title(loc="left") for axes in many.axes[:2]] == ["30 agents: action", "reward"]
    assert len(drawn(many.axes[0])) == 60
    assert texts(many.axes[0]) == ["1"]


def test_policies_with_too_many_different_actions_share_a_scale():
    names = [f"being_{place}" for place in range(30)]
    policies = {name: lambda seen, own=place: [own] * len(seen) for place, name in enumerate(names)}
    points = beings(action_space=spaces.Discrete(40))
    found = collect_episodes(herd(30, 1), policies, points=points, seeds=[5])
    scale = of(plot_timeline(found).axes[0], PolyCollection)[-1]
    assert scale.get_array().tolist() == list(range(30))
    assert scale.get_clim() == (0, 29)


def test_decisions_of_the_same_time_share_it():
    def main(simulation):
        simulation.crowd = [Being(number) for number in range(8)]
        for _ in range(2):
            for being in simulation.crowd:
                being.act()
                being.act()
            simulation.log.append(1)

    found = collect_episodes(clocked(main), {Being.act: ones}, points=beings(), seeds=[5])
    first = [cell[:2] for cell in drawn(plot_timeline(found).axes[0]) if cell[2] == pytest.approx(0)]
    assert first == [(0, 5), (5, 10), (10, 15), (15, 20)]


# -- what is asked for ----------------------------------------------------------------------------


def test_some_agents_can_be_chosen():
    found = collect_episodes(herd(50, 3), {Being.act: ones}, points=beings(), seeds=[5])
    figure = plot_timeline(found, agents=["being_7", "being_3"])
    assert [axes.get_title(loc="left") for axes in figure.axes[::2]] == ["being_7  (Being.act)", "being_3  (Being.act)"]
    with pytest.raises(UnknownAgentError, match="being_50"):
        plot_timeline(found, agents=["being_50"])
    with pytest.raises(OptionValueError, match="agents"):
        plot_timeline(found, agents="being_7")


def test_what_is_under_one_key_can_be_drawn():
    ant = decision(agent="ant_0")
    found = collect_episodes(calling(ant, ant), {ant: ones}, seeds=[1])
    assert dots(plot_timeline(found[ant]).axes[0]) == dots(plot_timeline(found).axes[0])


def test_episodes_are_counted_from_either_end():
    ant = decision(agent="ant_0")
    found = collect_episodes(calling(ant, ant), {ant: ones}, seeds=[7, 8, 9])
    assert plot_timeline(found, np.int64(1)).get_suptitle() == "Episode 1, seed 8"
    assert plot_timeline(found, -1).get_suptitle() == "Episode 2, seed 9"


@pytest.mark.parametrize("episode", [2, -3, 1.0, None])
def test_episodes_that_do_not_exist(episode):
    ant = decision(agent="ant_0")
    found = collect_episodes(calling(ant), {ant: ones}, seeds=[7, 8])
    with pytest.raises(OptionValueError, match="episode"):
        plot_timeline(found, episode)


def test_episodes_in_which_nobody_decides():
    ant = decision(agent="ant_0")

    def main(simulation):
        if simulation.seed == 1:
            ant()

    found = collect_episodes(script(main), {ant: ones}, seeds=[0, 1])
    with pytest.raises(OptionValueError, match=r"episode 0 \(seed 0\)"):
        plot_timeline(found, 0)
    plot_timeline(found, 1)
    with pytest.raises(OptionValueError, match="no agent has decided"):
        plot_returns(collect_episodes(script(main), {ant: ones}, seeds=[0]))


@pytest.mark.parametrize("wrong", [None, [], {}, {"ant": 1}, 3])
def test_what_cannot_be_drawn(wrong):
    with pytest.raises(OptionValueError, match="draw"):
        plot_timeline(wrong)
    with pytest.raises(OptionValueError, match="draw"):
        plot_returns(wrong)


def test_pictures_are_drawn_where_they_are_asked_for():
    found = collect_episodes(herd(8, 2), {Being.act: ones}, points=beings(), seeds=[5])
    whole = Figure(figsize=(20, 8), layout="constrained")
    left, right = whole.subfigures(1, 2)
    assert plot_timeline(found, figure=left) is left
    plot_timeline(found, agents=["being_0"], figure=right)
    axes = Figure().subplots()
    assert plot_returns(found, ax=axes) is axes.figure
    assert len(left.axes) > 2
    assert len(right.axes) == 2
    whole.canvas.draw()
    assert whole.get_size_inches().tolist() == [20, 8]


def test_notebooks_are_given_an_image():
    ant = decision(agent="ant_0")
    figure = plot_timeline(collect_episodes(calling(ant), {ant: ones}, seeds=[7]))
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.parametrize("draw", [plot_timeline, plot_returns])
def test_without_matplotlib_the_extra_is_named(monkeypatch, draw):
    ant = decision(agent="ant_0")
    found = collect_episodes(calling(ant), {ant: ones}, seeds=[7])
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[plots\]"):
        draw(found)


# -- returns --------------------------------------------------------------------------------------


def paid_by_seed(number, factor=1.0):
    """Beings each of which is paid the seed and its own number, twice."""

    def main(simulation):
        simulation.crowd = [Being(place) for place in range(number)]
        for being in simulation.crowd:
            being.health = simulation.seed * factor
        for _ in range(2):
            for being in simulation.crowd:
                being.act()

    points = beings(reward_mapping=lambda being: being.health + being.number)
    return collect_episodes(script(main), {Being.act: ones}, points=points, seeds=[1, 2, 6])


def rows_of(figure):
    """By the label of a row: where its points are."""
    (axes,) = figure.axes
    ticks = zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
    labels = {round(place, 6): text.get_text() for place, text in ticks}
    means = {round(float(line.get_ydata()[0]), 6): float(line.get_xdata()[0]) for line in axes.lines}
    points = [np.asarray(drawn.get_offsets())[:, 0].tolist() for drawn in of(axes, PathCollection)]
    assert [np.mean(values) for values in points] == pytest.approx(list(means.values()))
    return [(labels[place], values) for place, values in zip(means, points, strict=True)]


def test_a_point_is_the_mean_of_the_agents_of_an_episode():
    assert rows_of(plot_returns(paid_by_seed(3))) == [("Being.act", [4, 6, 14])]


def test_a_point_is_what_an_agent_has_got():
    rows = rows_of(plot_returns(paid_by_seed(2), per="agent"))
    assert rows == [("being_0", [2, 4, 12]), ("being_1", [4, 6, 14])]


def test_a_point_is_what_a_team_has_got():
    assert [values for _, values in rows_of(plot_returns(paid_by_seed(3), per="team"))] == [[12, 18, 42]]


def test_several_collections_stand_side_by_side():
    several = {"once": paid_by_seed(3), "twice": paid_by_seed(3, 2.0)}
    figure = plot_returns(several)
    assert rows_of(figure) == [("once", [4, 6, 14]), ("twice", [6, 10, 26])]
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels == ["Being.act", "once", "twice"]
    alone = plot_returns({name: found[Being.act] for name, found in several.items()})
    assert rows_of(alone) == rows_of(figure)
    assert rows_of(plot_returns(several, per="team")) == [("once", [12, 18, 42]), ("twice", [18, 30, 78])]


def test_agents_of_policies_that_share_an_episode_are_one_team():
    ant, bee = (decision(agent=name, reward_mapping=lambda paid=paid: paid) for name, paid in (("a", 1.0), ("b", 10.0)))
    found = collect_episodes(calling(ant, bee, ant), {ant: ones, bee: ones}, seeds=[3, 4])
    assert [values for _, values in rows_of(plot_returns(found, per="team"))] == [[12, 12]]


def test_episodes_without_a_decision_have_no_point():
    ant = decision(agent="ant_0", reward_mapping=lambda: 3.0)

    def main(simulation):
        if simulation.seed:
            ant()

    found = collect_episodes(script(main), {ant: ones}, seeds=[0, 1, 2])
    for per in ("policy", "agent", "team"):
        assert [values for _, values in rows_of(plot_returns(found, per=per))] == [[3, 3]]


def test_the_interval_of_the_mean_is_always_the_same():
    def interval():
        (axes,) = plot_returns(paid_by_seed(3)).axes
        return axes.texts[0].get_text()

    assert interval() == interval() == "8  [4, 14]"


def test_hundreds_of_agents_are_too_many_rows():
    many = collect_episodes(herd(100, 1), {Being.act: ones}, points=beings(), seeds=[5])
    with pytest.raises(OptionValueError, match="100 rows"):
        plot_returns(many, per="agent")
    plot_returns(many)
    with pytest.raises(OptionValueError, match="per"):
        plot_returns(many, per="wolf")


def test_what_the_rule_has_decided_is_shown_where_it_is_known():
    ant = decision(agent="ant_0", action_space_mapping={**dict(enumerate("abcdefghi")), 9: "rule"})
    answers = iter([[1], RULE, [3]])
    found = collect_episodes(calling(ant, ant, ant), {ant: lambda seen: next(answers)}, seeds=[1])
    assert dots(plot_timeline(found).axes[0]) == [([[0, 1], [2, 3]], True), ([[1, 9]], False)]
    points = beings(action_space_mapping={**dict(enumerate("abcdefghi")), 9: "rule"})
    policy = lambda seen: [RULE if number == 3 else 4 for number in seen[:, 0]]  # noqa: E731
    actions = plot_timeline(collect_episodes(herd(8, 2), {Being.act: policy}, points=points, seeds=[5])).axes[0]
    cells = of(actions, PolyCollection)[-1]
    assert texts(actions) == ["4", "9"]
    heights = [round(path.get_extents().height, 3) for path in cells.get_paths()]
    assert [height for height in heights if height != heights[0]] == [heights[6]] * 2
    assert heights[6] < heights[0] / 2
