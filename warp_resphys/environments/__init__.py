"""Gymnasium environments on corrected simulators: to learn policies in, and to try these on what plays the robot."""
