"""The search: fits of candidates by maximum likelihood, the score test of the dictionary, rounds, ties."""
