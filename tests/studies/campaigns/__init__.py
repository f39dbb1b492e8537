"""Monte Carlo campaigns: `python -m tests.studies.campaigns NAME --runs N --seed S --out DIR`.

The tests run small slices of the campaigns at fixed seeds; a command runs a whole campaign.
"""
