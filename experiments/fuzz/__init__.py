"""A fuzz campaign: damaged files go through the command line, and every answer is judged.

``python -m experiments.fuzz`` runs it; ``make fuzz N=1000`` does the same.
"""
