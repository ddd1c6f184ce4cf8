"""Planning: what actions are worth in the futures that an episode may have, and policies that decide by that.

Each module imports only from those below it::

    tree            a policy that looks several decisions ahead
    policy          one that looks one decision ahead
    values          what each candidate is worth
    futures         candidates tried out on common futures, in branches
    lookahead       how far and by what a future is valued, and what one is worth
    players         how the agent that decides goes through a branch, in each view
"""
