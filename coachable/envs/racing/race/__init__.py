"""What happens on a circuit: rules, starts, rivals, what a driver sees."""
