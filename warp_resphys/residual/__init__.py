"""Residual physics: the forces that a simulator lacks, and a network that predicts them."""
