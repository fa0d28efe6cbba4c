"""The fault campaign: the daemon as a process against the rig, each fault of a table injected in every phase of work.

Run by ``make faults`` (``python -m harness.campaign``). What must happen is not written here a second time: it is
derived from the fault catalogue, and what did happen is measured on the virtual devices themselves.
"""
