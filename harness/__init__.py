"""What tests and benchmarks both work with: daemons and devices to run against, floods, damage, the fault campaign."""
