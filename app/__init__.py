"""The deconfliction service: everything with I/O around the planner."""
