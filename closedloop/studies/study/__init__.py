"""Studies: many runs about one question, with a table, figures and files.

python -m closedloop.studies.study drift
python -m closedloop.studies.study controllers
python -m closedloop.studies.study surfaces
"""
