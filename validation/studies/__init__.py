"""Studies: many runs about one question, with a table, figures and files.

closedloop study drift
closedloop study controllers
closedloop study surfaces
"""
