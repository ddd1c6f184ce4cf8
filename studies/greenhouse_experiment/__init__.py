"""An experiment: one model, five questions, three learning libraries.

The five questions concern the same greenhouse. They differ in which decisions learn, and in what
the other decision does meanwhile. Neither the model nor its definitions change between questions,
only the view of the simulation.

    questions           the five questions, and the evaluation of trained policies
    runs                shared by all scripts: command line, workers, files
    baselines           baselines for learning: the rule, random actions, constants, CMA-ES
    sb3                 questions 1, 2, 3 and 5, by PPO of stable-baselines3
    torchrl             question 4, by IPPO and MAPPO of TorchRL
    rllib               question 4 without a common critic, by PPO of RLlib
    rllib_module        the RLModule of the rllib script
    results             learning curves and a table of all runs
    back_in_the_model   trained policies in the model's own loop

Run each script as a module: ``python -m studies.greenhouse_experiment.sb3 --help``.
"""
