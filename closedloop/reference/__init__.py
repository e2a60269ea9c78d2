"""The desired motion and the desired force, as functions of time made once, before the run.

    section of the scenario ──► TipPath        line, circle, figure_eight, raster, waypoints: r, ṙ, r̈ in closed form
                                   │
                                follow          least-norm inverse kinematics
                                   │
                                JointPath       q_des, q̇_des, q̈_des
                                   │
                                Desired         both, and f_des, as the table that the loop reads

`sections` holds what a scenario may say, `desired` puts everything together.
"""
