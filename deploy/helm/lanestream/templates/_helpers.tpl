{{- define "lanestream.name" -}}
{{- if contains "lanestream" .Release.Name -}}
{{ .Release.Name | trunc 50 | trimSuffix "-" }}
{{- else -}}
{{ printf "%s-lanestream" .Release.Name | trunc 50 | trimSuffix "-" }}
{{- end -}}
{{- end }}

{{/* Not the bare name: for a Service named lanestream, Kubernetes sets LANESTREAM_PORT in all pods of the namespace. */}}
{{- define "lanestream.serviceName" -}}
{{ include "lanestream.name" . }}-http
{{- end }}

{{- define "lanestream.redisName" -}}
{{ include "lanestream.name" . }}-redis
{{- end }}

{{/* The prefixes of all paths but `/`, which is exact, and `/metrics`, which stays inside the cluster. */}}
{{- define "lanestream.publicPrefixes" -}}
["/v1", "/static", "/docs", "/swagger", "/openapi.json", "/healthz", "/readyz"]
{{- end }}

{{/* The labels that select pods. They take a list: the root and a component, `service` or `redis`. */}}
{{- define "lanestream.selectorLabels" -}}
{{- $root := index . 0 -}}
app.kubernetes.io/name: lanestream
app.kubernetes.io/instance: {{ $root.Release.Name }}
app.kubernetes.io/component: {{ index . 1 }}
{{- end }}

{{- define "lanestream.labels" -}}
{{- $root := index . 0 -}}
{{ include "lanestream.selectorLabels" . }}
app.kubernetes.io/version: {{ $root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ $root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" $root.Chart.Name $root.Chart.Version }}
{{- end }}

{{- define "lanestream.image" -}}
{{- $repository := required "image.repository is missing: set it to the registry and name that the images were pushed to, such as registry.example.com/lanestream" .Values.image.repository -}}
{{- if .Values.image.digest -}}
{{ $repository }}@{{ .Values.image.digest }}
{{- else -}}
{{ $repository }}:{{ .Values.image.tag | default (printf "%s-%s" .Chart.AppVersion .Values.variant) }}
{{- end -}}
{{- end }}

{{/* The Secret with the API keys; empty if every caller is accepted. */}}
{{- define "lanestream.keysSecret" -}}
{{- if .Values.apiKeys.enabled -}}
{{- if and .Values.apiKeys.existingSecret .Values.apiKeys.entries -}}
{{- fail "apiKeys.existingSecret and apiKeys.entries are both set: use one of them" -}}
{{- else if .Values.apiKeys.existingSecret -}}
{{ .Values.apiKeys.existingSecret }}
{{- else if .Values.apiKeys.entries -}}
{{ include "lanestream.name" . }}-keys
{{- else -}}
{{- fail "no API keys: set apiKeys.existingSecret or apiKeys.entries, or apiKeys.enabled=false to accept every caller" -}}
{{- end -}}
{{- end -}}
{{- end }}

{{/* Where sessions are stored: `own` Redis of the chart, `external`, or empty. */}}
{{- define "lanestream.store" -}}
{{- if .Values.redis.existingSecret -}}
{{- if .Values.redis.enabled -}}
{{- fail "redis.existingSecret and redis.enabled are both set: set redis.enabled=false to use your own Redis" -}}
{{- end -}}
external
{{- else if .Values.redis.enabled -}}
{{- if not .Values.networkPolicy.enabled -}}
{{- fail "redis.enabled needs networkPolicy.enabled, because this Redis has no password: use your own one with redis.existingSecret" -}}
{{- end -}}
own
{{- end -}}
{{- end }}

{{/* The value of a setting as in an environment variable. Helm reads all numbers of a file as floats. */}}
{{- define "lanestream.settingValue" -}}
{{- if kindIs "slice" . -}}
{{ join "," . }}
{{- else if and (kindIs "float64" .) (eq (floor .) .) -}}
{{ printf "%.0f" . }}
{{- else -}}
{{ . }}
{{- end -}}
{{- end }}

{{/* preStop, the drain, and 15 s: the service ends at most two seconds after it has drained. */}}
{{- define "lanestream.gracePeriod" -}}
{{- $drain := .Values.settings.drain_s | default 10 | float64 -}}
{{ add .Values.preStopSeconds (ceil $drain | int) 15 }}
{{- end }}

{{- define "lanestream.podSecurityContext" -}}
runAsNonRoot: true
seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "lanestream.containerSecurityContext" -}}
readOnlyRootFilesystem: true
allowPrivilegeEscalation: false
capabilities: {drop: [ALL]}
{{- end }}
