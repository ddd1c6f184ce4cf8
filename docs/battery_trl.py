"""A language model learns by TRL to decide for a home battery. Here it is tiny, and made anew."""

import json
from typing import Any

from datasets import Dataset
from tokenizers import Tokenizer, decoders, models, pre_tokenizers
from transformers import PreTrainedTokenizerFast, Qwen3Config, Qwen3ForCausalLM
from trl import GRPOConfig, GRPOTrainer
from trl.chat_template_utils import qwen3_chat_template

from simenv_marl import single_env
from simenv_marl.errors import InvalidActionError
from simenv_marl.seats import describe, parse
from simenv_marl.testing.templates.plain import MyModel, MySimulation, flow

# -- the environment ------------------------------------------------------------------------------


class Battery:
    """An episode of the simulation, as TRL needs it. Its tool is the decision function."""

    def __init__(self) -> None:
        self._env = single_env(MySimulation, max_steps=24)
        self._total = 0.0

    def reset(self, seed: int, **row: Any) -> str:
        """Begin an episode with the seed of a row; return the first decision, for the prompt."""
        self._env.reset(seed=seed)
        self._total = 0.0
        return str(describe(self._env))

    def choose_flow(self, action: str) -> str:  # noqa: D102 - its docstring is the model's
        try:
            _, reward, *ends, _ = self._env.step(parse(self._env, action))
        except InvalidActionError as error:
            return str(error)
        self._total += reward
        return "The day is over." if any(ends) else str(describe(self._env))

    choose_flow.__doc__ = f"""{MyModel.choose_flow.__doc__}

        Args:
            action: {flow.question} (choices: {json.dumps(flow.action_labels)})

        Returns:
            The next decision.
        """

    def get_reward(self) -> float:
        """Return the reward of the episode."""
        return self._total


# -- a model and a tokenizer that need no download ------------------------------------------------

CALLS = [
    "<tool_call>\n"
    + json.dumps({"name": "choose_flow", "arguments": {"action": label}})
    + "\n</tool_call>"
    for label in flow.action_labels
]
END = "<|im_end|>"


def make_tokenizer() -> PreTrainedTokenizerFast:
    """Make a tokenizer with a token for each byte, and one for each call of the tool."""
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    bytewise = Tokenizer(models.BPE({letter: n for n, letter in enumerate(letters)}, []))
    bytewise.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    bytewise.decoder = decoders.ByteLevel()
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=bytewise, eos_token=END, pad_token="<|endoftext|>", padding_side="left"
    )
    tokenizer.add_tokens(["<|im_start|>"], special_tokens=True)
    tokenizer.add_tokens(CALLS)
    tokenizer.chat_template = qwen3_chat_template
    return tokenizer


def make_model(tokenizer: PreTrainedTokenizerFast) -> Qwen3ForCausalLM:
    """Make a language model of one small layer."""
    return Qwen3ForCausalLM(
        Qwen3Config(
            vocab_size=len(tokenizer),
            hidden_size=16,
            intermediate_size=16,
            num_hidden_layers=1,
            num_attention_heads=2,
            num_key_value_heads=1,
            head_dim=8,
            max_position_embeddings=16_384,
            eos_token_id=tokenizer.eos_token_id,
            pad_token_id=tokenizer.pad_token_id,
        )
    )


# -- the training ---------------------------------------------------------------------------------


def train(folder: str) -> GRPOTrainer:
    """Take one step of GRPO: four episodes of the same seed, with three decisions each."""
    tokenizer = make_tokenizer()
    said = tokenizer.convert_tokens_to_ids([*CALLS, END])
    trainer = GRPOTrainer(
        model=make_model(tokenizer),
        processing_class=tokenizer,
        environment_factory=Battery,
        train_dataset=Dataset.from_list(
            [
                {"prompt": [{"role": "user", "content": "Keep the costs low.\n"}], "seed": seed}
                for seed in range(4)
            ]
        ),
        args=GRPOConfig(
            output_dir=folder,
            max_steps=1,
            per_device_train_batch_size=4,
            num_generations=4,
            max_completion_length=4096,
            max_tool_calling_iterations=3,
            # It cannot speak yet, so it may say nothing but calls.
            generation_kwargs={"suppress_tokens": sorted({*range(len(tokenizer))} - {*said})},
            learning_rate=1e-3,
            use_cpu=True,
            report_to="none",
            save_strategy="no",
            logging_steps=1,
        ),
    )
    trainer.train()
    return trainer


if __name__ == "__main__":
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        log = train(folder).state.log_history[0]
    assert log["tools/call_frequency"] > 0 == log["tools/failure_frequency"]
    print({name: log[name] for name in ("loss", "reward", "tools/call_frequency", "step_time")})
