"""Plans in other people's simulations, beside published results and bounds."""
