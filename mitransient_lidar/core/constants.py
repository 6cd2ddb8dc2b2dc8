"""Physical constants (SI, 2019: exact values)."""

C0 = 299792458.0  #: Speed of light in vacuum [m/s].
PLANCK = 6.62607015e-34  #: Planck constant [J s].
BOLTZMANN = 1.380649e-23  #: Boltzmann constant [J/K].
AVOGADRO = 6.02214076e23  #: Avogadro constant [1/mol].
ELEMENTARY_CHARGE = 1.602176634e-19  #: Elementary charge [C].
