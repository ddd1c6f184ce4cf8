"""Mesa-LLM's example ``negotiation``, unmodified: each answer of its language model is a decision.

Run it in the folder of Mesa-LLM's source distribution, which contains the example. A fake endpoint
answers.
"""

import json
import os
import re
import tempfile
from contextlib import redirect_stdout
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import StringIO
from threading import Thread
from typing import Any

import examples.negotiation.tools  # noqa: F401 - the buyers' tool, which the app imports
from examples.negotiation.model import NegotiationModel
from litellm import ModelResponse
from mesa_llm.reasoning.react import ReActReasoning
from openai import AsyncOpenAI

from simenv_marl import RULE, SteppedSimulation, aec_env, clone, make_step, simulate, simulate_many
from simenv_marl.seats import RecordedPolicy, free_text

# -- the definition -------------------------------------------------------------------------------


def request_of(llm: Any, **asked: Any) -> str:
    """Return what the model asks, as the JSON of a request."""
    form = asked.get("response_format")
    shape = form and {"name": "answer", "schema": form.model_json_schema()}
    tools = asked.get("tool_schema")
    request = {
        "messages": llm._build_messages(asked["prompt"], asked.get("system_prompt")),
        "tools": tools,
        "tool_choice": asked.get("tool_choice") if tools else None,
        "response_format": shape and {"type": "json_schema", "json_schema": shape},
    }
    return json.dumps({name: part for name, part in request.items() if part})


def name_of(llm: Any, *, _simulation: Any) -> str:
    """Return the name of the buyer or the seller that asks."""
    agents = _simulation.model.agents
    [agent] = [each for each in agents if llm in (each.llm, each.memory.llm)]
    return f"{type(agent).__name__}_{agent.unique_id}"


generate = make_step(
    agent=name_of,
    observation_space=free_text(1_000_000),
    observation_space_mapping=request_of,
    action_space=free_text(100_000),
    action_space_mapping=lambda text: ModelResponse(choices=[{"message": json.loads(text)}]),
    rule_action_mapping=lambda response: text_of(response.choices[0].message),
    reward_mapping=lambda *call: 0.0,
)
POINTS = {"mesa_llm.module_llm.ModuleLLM.generate": generate}


def text_of(message: Any) -> str:
    """Return a message as JSON."""
    return str(message.model_dump_json(include={"role", "content", "tool_calls"}))


# -- a fake endpoint ------------------------------------------------------------------------------


def reply(request: dict[str, Any]) -> dict[str, Any]:
    """Answer as a language model would: first with a plan, then with the call of a tool."""
    asked = request["messages"][-1]["content"]
    if "response_format" in request:
        budget = re.search(r"Your budget is \$(\d+)", asked)
        plan = f"praise the shoes, {len(asked)} times"
        if budget:
            plan = "buy shoes" if int(budget[1]) >= 35 else "look around"
        return {"content": json.dumps({"reasoning": "It is time.", "action": plan})}
    name, arguments = "speak_to", {"listener_agents_unique_ids": [1, 2], "message": asked}
    if asked == "buy shoes":
        name, arguments = "buy_product", {"chosen_product": "Brand B Shoes", "chosen_price": 35}
    call = {"name": name, "arguments": json.dumps(arguments)}
    return {"content": None, "tool_calls": [{"id": "1", "type": "function", "function": call}]}


class Endpoint(BaseHTTPRequestHandler):
    """Serves the replies, and counts them."""

    count = 0

    def do_POST(self) -> None:
        """Answer a request."""
        Endpoint.count += 1
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        message = {"role": "assistant", **reply(request)}
        choice = {"index": 0, "finish_reason": "stop", "message": message}
        answer = {"id": "1", "object": "chat.completion", "created": 1, "model": "fake"}
        body = json.dumps(answer | {"choices": [choice]}).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None:
        """Print nothing."""


server = ThreadingHTTPServer(("127.0.0.1", 0), Endpoint)
Thread(target=server.serve_forever, daemon=True).start()
URL = f"http://127.0.0.1:{server.server_port}/v1"
os.environ["OPENAI_API_KEY"] = "none"

# -- what becomes of it ---------------------------------------------------------------------------

make_model = partial(
    NegotiationModel,
    initial_buyers=3,
    width=4,
    height=4,
    reasoning=ReActReasoning,
    llm_model="openai/fake",
    vision=5,
    api_base=URL,
    parallel_stepping=False,
)
client = AsyncOpenAI(base_url=URL)


async def ask(observation: str) -> str:
    """Ask the same endpoint, while other simulations wait for theirs."""
    response = await client.chat.completions.create(model="fake", **json.loads(observation))
    return text_of(response.choices[0].message)


def log_of(simulation: Any) -> list[Any]:
    """Return all that buyers and sellers have heard, said and done, and what was sold."""
    agents = simulation.model.agents
    heard = [[str(entry.content) for entry in agent.memory.short_term_memory] for agent in agents]
    return [heard, simulation.model.seller_a.sales, simulation.model.seller_b.sales]


def main() -> str:
    """Run the model plainly, by the rule, many times at once, from a recording, and in a clone."""
    negotiation = SteppedSimulation(make_model, 2)
    negotiation.reset(seed=1)
    negotiation.run()
    plain = log_of(negotiation)
    by_rule = simulate(negotiation, dict.fromkeys(POINTS, leave), points=POINTS, seed=1)
    assert log_of(by_rule) == plain

    with tempfile.TemporaryDirectory() as folder:
        recorded = RecordedPolicy(ask, f"{folder}/answers.jsonl")
        given = {"points": POINTS, "seeds": range(32), "collect": log_of}
        Endpoint.count = 0
        logs = simulate_many(negotiation, dict.fromkeys(POINTS, recorded), **given)
        requests = Endpoint.count
        assert logs[1] == plain
        recorded = RecordedPolicy(ask, f"{folder}/answers.jsonl")
        assert simulate_many(negotiation, dict.fromkeys(POINTS, recorded), **given) == logs
        assert Endpoint.count == requests

    env = aec_env(negotiation, POINTS)
    env.reset(seed=1)
    for _ in range(5):
        env.step(RULE)  # in the middle of the model's step
    twin = clone(env)
    for each in (twin, env):
        while each.agents:
            each.step(RULE)
        assert each.unwrapped.call(lambda view: log_of(view.simulation)) == plain
        each.close()
    return f"{requests} requests for 32 negotiations, none again, {logs[1][2]} shoes in one of them"


def leave(observation: str) -> Any:
    """Leave the decision to the model's own call of the endpoint."""
    return RULE


if __name__ == "__main__":
    with redirect_stdout(StringIO()):  # the model prints each step
        outcome = main()
    print(outcome)
