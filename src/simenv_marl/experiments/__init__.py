"""Experiments: contenders on the same seeds, designs, sweeps that resume, and what factors do."""
