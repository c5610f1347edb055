"""What a user meets: the pipeline of stages, the command line, the studio, the report, Python."""
