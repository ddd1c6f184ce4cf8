"""An agency that collects debts: its model, its environments, and a policy for it."""
