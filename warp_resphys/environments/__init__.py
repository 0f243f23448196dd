"""Gymnasium environments on corrected simulators, to learn policies
and to test them on the simulated laboratory.
"""
