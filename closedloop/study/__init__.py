"""Studies: many runs that answer one question, as a table, figures and files.

python -m closedloop.study drift
"""
