from closedloop.compiled import kernel
from closedloop.solve import OK

NEWTON, POISSON, STRONGE = 0, 1, 2


@kernel
def impact(S, u, restitution, law, mu, work, compression, decompression, after):
    for i in range(3):
        compression[i] = 0.0
        decompression[i] = 0.0
    compression[0] = -u[0] / S[0, 0]
    decompression[0] = restitution * compression[0]
    for i in range(3):
        after[i] = u[i] + S[i, 0] * (compression[0] + decompression[0])
    after[0] = -restitution * u[0]
    return OK
