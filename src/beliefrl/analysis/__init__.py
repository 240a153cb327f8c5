"""Figures and tables made from the logs of runs."""
