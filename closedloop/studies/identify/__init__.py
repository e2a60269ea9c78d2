"""Identification: the parameters of a robot from a log of its motion and of its torques."""
