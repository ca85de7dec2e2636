"""Which effects are missing: the objective, the noise model, the evidence and the decision rule.

Objective. Recordings i = 1..N are simulated freely, y_i = h(u_i; theta, eta, x0_i) + e_i, with the nominal parameters theta,
those of the active effects eta and, for effects with memory, the state x0_i at each recording's first sample. theta and
eta minimize the Huber cost (threshold 4) of the weighted errors of all recordings to fit (Levenberg-Marquardt); x0_i
minimizes each recording's own error. Outputs are weighted by what the nominal model leaves, no less than their noise.
A free mass is compared in weak form instead (models/balance.py).

Noise. Its standard deviation and colour come from stretches in which no input moves, else from the quietest part of the
spectrum; never from the residual to be explained. A residual that is correlated counts as n / tau independent samples,
tau its integrated autocorrelation time (Geyer 1992).

Evidence. The gain of one model over another is sum over outputs of n / (2 tau) log(MSE / MSE'), on samples to fit, on
held-out ones and on both, with a p-value over held-out blocks of four correlation times (t test and signed ranks).

Decision. Forward selection: candidates are screened by projection on the residual past all active parameters, the best
are fitted in full, and the best of these enters if its evidence passes `SelectionRules`. A finer form of an active effect
takes its place. Backward elimination: an effect that no longer earns its place leaves. Exchange: each effect is taken out
and all candidates are tried in its place; the second-best first effects are tried as starts. What remains is put to
simple forms of the recorded signals and to symbolic regression (`unlisted`). Rivals that the data do not separate are
listed (`equivalence`), and everything that was fitted gets its probability (`posterior`).
"""
