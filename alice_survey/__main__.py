"""`python -m alice_survey` is the command line."""

from alice_survey.cli.main import main

main()
