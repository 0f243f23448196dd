"""Damaged files."""


def flip_bit(path, place=-9):
    """Flips a bit of a file, without changing its length."""
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
