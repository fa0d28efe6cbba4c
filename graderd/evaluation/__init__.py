"""Work quality from depth seen from above: height difference, degree of spread, volumes, and what differs by angle.

``ground`` and ``bed`` make a map of heights of repeated scans, ``measures`` takes numbers from it, ``uncertainty`` says
how sure they are: numpy and OpenCV, no files. ``depth_files`` reads scans, ``experiment`` the file that groups them,
``trial`` does one trial, ``statistics`` the whole, ``page`` writes it down; ``study`` holds the study's own numbers.
Nothing of the daemon imports it; scipy, plyfile and laspy come with the extra ``graderd[evaluation]``.
"""
