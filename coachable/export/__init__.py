"""Export of agents to formats that run without this library."""
