"""What is the same for every model of a column: rules, recipes, schedules, splits."""
