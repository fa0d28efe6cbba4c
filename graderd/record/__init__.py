"""What the machine did, kept: the recorder with its black box, and what reads its files (replay, report)."""
