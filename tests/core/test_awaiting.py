"""Answers of policies that are on their way: reported, taken, cancelled."""

import asyncio

import pytest

from simenv_marl.core.switching.awaiting import Answers, wait_for


def test_coroutine_policies_answers_are_returned_with_their_decisions_keys():
    async def double(number):
        await asyncio.sleep(0)
        return 2 * number

    answers = Answers()
    for number in (1, 2):
        answers.add(number, double(number))
    answers.add(3, 6)
    taken = dict(answers.take() for _ in range(3))
    assert {key: answer.result() for key, answer in taken.items()} == {1: 2, 2: 4, 3: 6}
    assert not answers


def test_coroutine_policies_that_are_cancelled_end_and_lose_their_answers():
    ended = []

    async def wait():
        try:
            await asyncio.sleep(100)
        finally:
            await asyncio.sleep(0)
            ended.append(True)

    answers = Answers()
    answers.add("come", 1)
    answers.add("waits", wait())
    answers.cancel()
    assert len(answers) == 0
    assert ended == [True]
    answers.add("later", 2)
    assert answers.take()[0] == "later"


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt, SystemExit])
def test_errors_of_coroutine_policies_are_raised_where_the_answer_is_read(kind):
    async def fail():
        raise kind("no")

    for _ in range(2):  # the event loop survives
        with pytest.raises(kind, match="no"):
            wait_for(fail())
