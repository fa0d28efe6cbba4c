"""SAE J1939 as pure protocol machines: no socket, no task, no clock of their own."""
