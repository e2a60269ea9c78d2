"""The loop as a machine that asks for what it needs: steps, events, impacts and projections in one place.

phases    what it asks for, and what the terms that arrive are for
proceed   one turn of the machine
steps     setting out on a substep, and coming to its end
locate    when an event happens
events    what an event does
close     projection
"""
