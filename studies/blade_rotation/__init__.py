"""The study behind the rotation rule, repeatable: grains in front of a turned blade (DEM by LAMMPS, MBD by MuJoCo).

``case`` says what is computed, as data; ``pile`` pours the soil; ``contact`` is Table 2 in engine terms; ``lammps``
writes its input, ``engine`` runs it as a subprocess; ``run`` makes a result of a case, ``outcome`` takes its measures,
which are ``graderd.evaluation``'s; ``store`` keeps it under the hash of its case.
"""
