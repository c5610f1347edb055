"""`python -m alice_survey` is the command line."""

from alice_survey.app.cli.main import main

main()
