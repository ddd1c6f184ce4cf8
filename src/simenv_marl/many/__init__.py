"""Many simulations at once, in this process or in several."""
