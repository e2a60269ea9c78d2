"""The laws of friction that ship, a file each, of the surface and of joints.

none               no friction
coulomb            of one size, against the slip
coulomb_viscous    the same, and a part proportional to the slip
stribeck           falls from static to kinetic as slip gets faster    Bo and Pavelescu 1982
karnopp            slip within a band of speeds counts as none         Karnopp 1985
dahl               an elastic bristle that yields                      Dahl 1968
lugre              damped bristles that yield at the Stribeck curve    Canudas de Wit et al. 1995
seven_parameter    rises with rest, lags the slip                      Armstrong-Hélouvry et al. 1994
"""
