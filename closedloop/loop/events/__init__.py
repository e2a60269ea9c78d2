"""Steps, events, impacts and projections: the time stepping of a run, by reverse communication.

proceed      one call: use the terms requested last, request the next; a state moved onto the closure
substep      begin and end of a substep
locate       phases and actions, event functions, and the bracket around the instant of an event
transitions  what an event does to the state and the contact mode: impacts of the tip above all
contacts     events of the contacts of the links
table        the table of events
"""
