"""One model, five questions, three learning libraries.

Five questions are asked about the same greenhouse: who learns, and what the other decision does meanwhile. Nothing in
the model is changed for any of them, and nothing in its definitions either; only the view of it is another.

    questions           the five questions, and how whatever has been learnt for one is judged
    runs                command line, workers, files: what all scripts have in common
    baselines           what learning is compared with: the rule, random actions, constants, CMA-ES
    sb3                 questions 1, 2, 3 and 5, by PPO of stable-baselines3
    torchrl             question 4, by IPPO and MAPPO of TorchRL
    rllib               question 4 without a common critic, by PPO of RLlib
    rllib_module        the module that it learns with
    results             learning curves and a table out of all runs
    back_in_the_model   what has been learnt, at work in the model's own loop

Each script is run as a module: ``python -m examples.greenhouse_coop.experiment.sb3 --help``.
"""
