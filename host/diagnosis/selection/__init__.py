"""Which effects are missing: the objective, the noise model, the evidence and the decision rule.

Objective. Recordings i = 1..N are simulated freely, y_i = h(u_i; theta, eta, x0_i) + e_i, with the nominal parameters
theta, those of the active effects eta and, for models and effects with memory, the state x0_i at each recording's first
sample. theta, eta and x0 minimize the Huber cost (threshold 4) of the weighted errors of all recordings to fit
(Levenberg-Marquardt). What a change of x0 explains is projected out of residuals and Jacobian (variable projection, Golub
and Pereyra 2003); of a model that is linear between two ports, x0, theta and eta take Gauss-Newton steps together.
Outputs are weighted by the residual of the nominal model, no less than their noise. A free mass is simulated too; its
forces are compared in weak form (models/balance.py) if single effects do not explain its motion down to the noise.

Noise. Its standard deviation and colour come from stretches in which no input moves, else from the difference of two
stretches with the same motion, else from the quietest part of the spectrum; never from the residual to be explained. A
residual that is correlated counts as n / tau independent samples, tau its integrated autocorrelation time (Geyer 1992).

Evidence. The gain of one model over another is sum over outputs of n / (2 tau) log(MSE / MSE'), on samples to fit, on
held-out ones and on both, with a p-value over held-out blocks of four correlation times (t test and signed ranks).

Decision. Forward selection: candidates are screened by projection on the residual past all active parameters, the best are
fitted in full, and the best of these enters if its evidence passes `SelectionRules`. A finer form of an active effect takes
its place. Backward elimination: an effect that no longer earns its place leaves (`removal`). Exchange: each effect is taken
out and all candidates are tried in its place; the second-best first effects are tried as starts. What remains is put to
simple forms of the recorded signals and to symbolic regression (`unlisted`). Rivals that the data do not separate are
listed (`equivalence`), and everything that was fitted gets its probability (`posterior`).
"""
