"""Hardware in the loop on any machine: start a guest that has a CAN stack, run a command in it, clean up."""
