"""The paper's matrix of experiments: policies that water, over plants, climates and plugins."""
