"""One law for the verdict: log evidence in place of rules, as answers for the runs of a blind check.

It takes residuals, columns and forms of effects from `agent.diagnosis`, and replaces what `agent diagnose` decides by.
"""
