"""The world without TORCS: a planar simulation of ``car1-trb1``, compiled by numba."""
