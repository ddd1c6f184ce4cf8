"""Processes forked by a simulation have no user: their decisions are refused."""

import sys

import pytest

from tests.processes import run_code
from tests.worlds.models import BY_DRIVER

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the platform does not fork")

PREAMBLE = """
    import multiprocessing, os, signal, warnings

    from simenv_marl import single_env
    from simenv_marl.errors import WrongThreadError
    from tests.worlds.models import Script, decision, script

    signal.alarm(30)  # so that none waits for ever
    os.register_at_fork(after_in_child=lambda: signal.alarm(30))
    warnings.simplefilter("ignore", DeprecationWarning)  # of forks where there are threads
    context = multiprocessing.get_context("fork")
    decide, other = decision(), decision(lambda: "not active")
    RULED, REFUSED = ("decided", "rule", "not active"), ("refused", True, "not active")

    def ask(*_):
        try:
            return "decided", decide(), other()
        except WrongThreadError as error:
            return "refused", "forked" in str(error), other()

    def ask_twice(_):
        first, second = ask(), ask()
        return second if first == second else (first, second)

    class Pool:
        def __init__(self):
            # A thread of the pool forks all workers but the first.
            self.pool = context.Pool(1, maxtasksperchild=1)
        def ask(self):
            told = {self.pool.apply_async(ask_twice, [0]).get(20) for _ in range(3)}
            self.pool.close()
            self.pool.join()
            return told

    def play(between, make=Script):
        def main(simulation):
            simulation.log.append(decide())
            simulation.log.append(between(simulation))
            simulation.log.append(decide())
        env = single_env(lambda: make(main), decide, driver=driver)
        env.reset()
        assert [env.step(action)[2] for action in (1, 2)] == [False, True]
        assert env.simulation.log[::2] == [1, 2]
        env.close()
        return env.simulation.log[1]

    user = os.getpid()
"""


def run(code, driver):
    """Run code in a process of its own, which no worker leaves as a second one."""
    assert (
        run_code(f"driver = {driver!r}", PREAMBLE, code, "print('end', os.getpid() == user)")
        == "end True\n"
    )


@BY_DRIVER
def test_process_pool_that_a_model_forks_in_run_cannot_decide(driver):
    run(
        """
        for _ in range(2):
            assert play(lambda simulation: Pool().ask()) == {REFUSED}
        """,
        driver,
    )


@BY_DRIVER
def test_process_pool_forked_before_run_follows_the_models_rule(driver):
    run(
        """
        class Model(Script):
            def reset(self, seed=None, options=None):
                super().reset(seed, options)
                self.workers = Pool()
        told = play(lambda simulation: simulation.workers.ask(), Model)
        assert RULED in told
        assert told <= {RULED, REFUSED}
        """,
        driver,
    )


@BY_DRIVER
def test_forked_worker_process_can_use_environments_of_its_own(driver):
    run(
        """
        def play_own(queue):
            model = script(lambda simulation: simulation.log.append(decide()))
            env = single_env(model, decide, driver=driver)
            env.reset()
            queue.put((env.step(7)[2], env.simulation.log, ask()[0]))
            env.close()
        def between(simulation):
            queue = context.SimpleQueue()
            worker = context.Process(target=play_own, args=(queue,))
            worker.start()
            told = queue.get()
            worker.join()
            return told
        assert play(between) == (True, [7], "refused")
        """,
        driver,
    )
