"""Systems that run: roll-outs and Kalman passes with sensitivities, through CasADi and C.

May import ``definition``. ``system`` has the type that effects change, ``simulator`` runs it, ``kalman_pass`` filters
with it.
"""
