"""Monte Carlo campaigns: `python -m tests.studies.campaigns NAME --runs N --seed S --out DIR`.

The tests run small slices of them with fixed seeds; the whole of a campaign is a command.
"""
