"""The rows of the fault catalogue, one module for each kind of device."""
