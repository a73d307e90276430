"""Sparse symmetric systems of small blocks: order, analyse, factor, solve, invert in part."""
