"""Steps, events, impacts and projections: the time stepping of a run, by reverse communication.

phases       phases, actions and tolerances
proceed      one call: use the terms requested last, request the next
substep      begin and end of a substep
locate       event functions, and the bracket around the instant of an event
transitions  what an event does to the state and the contact mode
impacts      impulses of the tip, and the rows of the table
contacts     events of the contacts of the links
projection   a state moved onto the closure
table        the table of events
"""
