"""The control laws that ship, a file each.

paper               Eq. 33                                             the paper
hybrid              position and force each along its own directions   Raibert and Craig 1981
operational_space   the tip's own dynamics made linear                 Khatib 1987
dynamic_hybrid      the same through joint accelerations               Yoshikawa 1987
impedance           a wished spring and damper at the tip              Hogan 1985
admittance          a set point that yields to the force               Whitney 1977
"""
