"""A finished experiment as one object: the identified simulator with its learned force.

`loading.load` makes a `robot.Robot` from a run folder or from a file of `Robot.save`. Its roll-outs
are `dynamics.trajectory.Motion` objects, which write CSV, VTK and USD files.
"""
