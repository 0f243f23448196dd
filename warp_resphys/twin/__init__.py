"""A twin: a robot's simulator that follows the running robot by its markers, and looks ahead."""
