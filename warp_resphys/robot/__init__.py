"""A finished experiment in one's hands: the identified simulator with its learned force, as one object.

`loading.load` makes a `robot.Robot` of a run folder or of the file that `Robot.save` wrote; a `motion.Motion` is what
it does, and goes to CSV, VTK and USD files; `program.export_network` writes what it has learned for torch alone.
"""
