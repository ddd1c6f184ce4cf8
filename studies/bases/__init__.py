"""What stands for the other planners in a planner's branches."""
