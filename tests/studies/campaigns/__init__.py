"""Monte Carlo campaigns: `python -m tests.studies.campaigns NAME --runs N --seed S --out DIR`.

The tests run a few cases of each campaign with fixed seeds; the command runs a whole campaign.
"""
