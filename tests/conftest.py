"""Property tests draw the same examples each time, so that a change is judged by what it changes.

python -m pytest --hypothesis-profile=explore      # other examples each time, to look for what was missed
"""

from hypothesis import settings

settings.register_profile("same", derandomize=True)
settings.register_profile("explore")
settings.load_profile("same")
