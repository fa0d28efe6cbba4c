"""AgIsoStack++ on our bus; ``python -m harness.peers.agisostack`` compiles and runs it."""
