"""Studies: many runs about one question, with a table, figures and files.

python -m closedloop.study drift
python -m closedloop.study controllers
python -m closedloop.study surfaces
"""
