"""What a running command carries: its threads or cluster, and how it is interrupted."""
