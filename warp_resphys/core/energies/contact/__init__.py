"""Contact of bodies with rigid obstacles, with one another and with themselves."""
