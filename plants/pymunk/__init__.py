"""Cart-poles and their relatives in pymunk.

``plant`` has what they share; add one as a file with its own bodies and constraints.
"""

NEEDS = ("pymunk",)
