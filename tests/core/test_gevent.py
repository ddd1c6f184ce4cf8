"""Models that wait in gevent's hub, which serves their own greenlets and those of their user."""

import pytest

from tests.processes import run_code
from tests.worlds.models import BY_DRIVER

pytest.importorskip("gevent")

PREAMBLE = """
    import gc, signal, sys
    import gevent
    from simenv_marl import single_env
    from simenv_marl.errors import WrongThreadError
    from tests.worlds.models import decision, script

    if hasattr(signal, "alarm"):
        signal.alarm(30)  # so that none waits for ever

    decide, other = decision(), decision(lambda: "not active")
    told = []

    def ask():
        try:
            told.append(decide())
        except WrongThreadError as error:
            told.append("spawned with gevent" in str(error) and "refused")
        told.append(other())

    def waiting(simulation):
        for _ in range(3):
            gevent.sleep(0.01)
            simulation.log.append(decide())
            gevent.sleep(0.01)
"""


def run(code, driver="greenlet"):
    """Run code in a process of its own, whose hub nothing else has used."""
    assert run_code(f"driver = {driver!r}", PREAMBLE, code, RULED) == "end\n"


RULED = """
    env.close()
    told.clear()
    gevent.spawn(ask).join(timeout=10)
    assert told == ["rule", "not active"]
    print("end")
"""
"""The end of all: nobody is asked any more."""


@pytest.mark.thorough
@BY_DRIVER
@pytest.mark.parametrize("first", ["user", "model"])
@pytest.mark.parametrize("where", ["main", "spawned"])
def test_gevent_decision_in_the_users_greenlets_follows_the_models_rule(where, first, driver):
    """Whichever of the two has used the hub first, and wherever the user steps."""
    if (where, first, driver) == ("main", "model", "greenlet"):
        return  # a hub that begins in a simulation belongs to it
    run(
        f"""
        if {first!r} == "user":
            gevent.sleep(0)
        def use():
            for _ in range(2):
                told.clear()
                env.reset()
                asking = [gevent.spawn(ask) for _ in range(2)]
                assert not env.step(1)[2]
                asking.append(gevent.spawn_later(0.005, ask))
                asking.append(gevent.spawn(lambda: gevent.spawn(ask).join()))
                assert not env.step(2)[2]
                gevent.joinall(asking, timeout=10, raise_error=True)
                assert told.count("rule") == told.count("not active") == 4 == len(told) / 2
                assert env.step(3)[2]
                assert env.simulation.log == [1, 2, 3]
        env = single_env(script(waiting), decide, driver=driver)
        use() if {where!r} == "main" else gevent.spawn(use).get(timeout=20)
        """,
        driver,
    )


@pytest.mark.thorough
@pytest.mark.parametrize("first", ["user", "model"])
@pytest.mark.parametrize(
    "how",
    [
        "gevent.spawn(ask).join()",
        "gevent.spawn(lambda: gevent.spawn(ask).join()).join()",
        "gevent.spawn_raw(ask); gevent.sleep(0.02)",
    ],
    ids=["spawned", "in turn", "raw"],
)
def test_gevent_model_that_spawns_greenlets_on_the_users_hub_is_refused(how, first):
    run(
        f"""
        if {first!r} == "user":
            gevent.sleep(0)
        def main(simulation):
            decide()
            {how}
            decide()
        env = single_env(script(main), decide)
        for _ in range(2):
            told.clear()
            env.reset()
            try:
                env.step(1)
            except WrongThreadError as error:
                assert "spawned with gevent" in str(error)
            else:
                raise AssertionError(told)
            assert told == ["refused", "not active"]
        """
    )


def test_gevent_model_with_a_hub_of_its_own_can_decide_in_greenlets():
    run(
        """
        def main(simulation):
            simulation.log.append(decide())
            gevent.joinall([gevent.spawn(ask) for _ in range(2)])
            simulation.log.append(decide())
        env = single_env(script(main), decide, driver="thread")
        for _ in range(2):
            told.clear()
            env.reset()
            assert [env.step(number)[2] for number in range(4)] == [False, False, False, True]
            assert (env.simulation.log, told) == ([0, 3], [1, "not active", 2, "not active"])
        env.reset()
        env.step(1)
        """
    )


@pytest.mark.parametrize("how", ["close", "reset"])
def test_gevent_model_that_waits_in_its_hub_is_unwound_by_env_close(how):
    run(
        f"""
        unwound = []
        def main(simulation):
            try:
                waiting(simulation)
            finally:
                gevent.sleep(0.01)
                unwound.append(len(simulation.log))
        env = single_env(script(main), decide)
        env.reset()
        env.step(1)
        env.{how}()
        assert unwound == [1]
        """
    )


PATCHED = """
    import signal
    from gevent import monkey
    monkey.patch_all({})
    signal.alarm(30)
    from simenv_marl import clone, single_env
    from simenv_marl.errors import SimulationError
    from tests.worlds.models import decision, script

    decide = decision()
    model = script(lambda simulation: [decide() for _ in range(3)])
    try:
        env = single_env(model, decide, driver=driver)
    except SimulationError as error:
        print(error)
    else:
        env.reset(seed=1)
        env.step(1)
        with clone(env) as twin:  # a replay, because gevent's hub waits in this process
            twin.step(2)
            assert twin.simulation.log == []  # that of a fork would be in another process
        env.close()
    print("end")
"""


@pytest.mark.thorough
@BY_DRIVER
def test_thread_driver_refuses_threads_that_gevent_has_patched(driver):
    told = run_code(f"driver = {driver!r}", PATCHED.format(""))
    assert "patch_all(thread=False, queue=False)" in told
    assert run_code(f"driver = {driver!r}", PATCHED.format("thread=False, queue=False")) == "end\n"
