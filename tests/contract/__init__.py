"""What happens when, whatever the driver: each test here runs with every one of them."""
