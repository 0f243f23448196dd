"""Contact: distances from obstacles and between triangles,
pairs that come near one another, barriers and friction.
"""
