"""Experiments: contenders on the same seeds, designs, sweeps that can be resumed, and effects of factors."""
