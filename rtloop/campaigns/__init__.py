"""Campaigns: one configuration on thousands of simulated rigs that differ; and verdicts on archives of recordings.

`campaign_file` reads CAMPAIGN.toml, `samples` draws the uncertain parameters, `case` runs one rig, `unit` runs many in
a worker, `coordinator` hands units to workers, `store` keeps their results, `summary` reports; `search` looks for the
worst rig, `archive` replays recordings. It may import design and the rooms below it. Begin reading with `case`.
"""
