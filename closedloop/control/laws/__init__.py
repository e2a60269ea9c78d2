"""The control laws that ship, a file each.

paper               Eq. 33                                             the paper
hybrid              position and force each along its own directions   Raibert and Craig 1981
operational_space   feedback linearisation of the tip's dynamics       Khatib 1987
dynamic_hybrid      the same through joint accelerations               Yoshikawa 1987
impedance           a desired spring and damper at the tip             Hogan 1985
admittance          the force error moves the set point                Whitney 1977
servo_admittance    the same over a position servo of the joints       Whitney 1977
"""
