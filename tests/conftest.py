"""What holds for all tests.

Property tests draw the same examples each time, so that a change is judged by what it changes. And no arm gets a loop
of its own for being the first: the tests have arms of many sizes, and each would compile for ten seconds.

python -m pytest --hypothesis-profile=explore      # other examples each time, to look for what was missed
"""

from hypothesis import settings

from closedloop import forms

settings.register_profile("same", derandomize=True)
settings.register_profile("explore")
settings.load_profile("same")
forms.FIRST_HAS_ITS_OWN = False
